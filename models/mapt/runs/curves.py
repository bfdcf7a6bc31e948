"""Curves of true return over steps: mean and spread over seeds, one panel for each task."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from mapt.runs.results import Group, RunResult
from mapt.studies.palette import style

#: parts of a curve, in each of which a seed's points are averaged: more cannot be told apart
MOST_BINS = 150


@dataclass(frozen=True, slots=True)
class SeedCurves:
    """Curves of several seeds at the same steps."""

    #: (B,)
    steps: NDArray[np.float64]
    #: (seeds, B); NaN outside of what a seed has seen
    returns: NDArray[np.float64]

    def whole(self) -> NDArray[np.bool_]:
        """(B,): where every seed has a value; elsewhere a mean would jump where a seed ends."""
        return np.all(np.isfinite(self.returns), axis=0, keepdims=True)[0]


def seed_curves(runs: Sequence[RunResult], most_bins: int = MOST_BINS) -> SeedCurves:
    """Means of each run's points by bins of steps; a bin without points lies on the line between its neighbours."""
    points = max(len(run.curve_steps) for run in runs)
    last = max(int(run.curve_steps[-1]) for run in runs if len(run.curve_steps))
    edges = np.linspace(0, last, min(points, most_bins) + 1)
    # Binned alike, steps at the bins' ends and returns belong together for all seeds.
    return SeedCurves(edges[1:], np.stack([_binned(run, edges) for run in runs]))


def _binned(run: RunResult, edges: NDArray[np.float64]) -> NDArray[np.float64]:
    values = np.full(len(edges) - 1, np.nan)
    if not len(run.curve_steps):
        return values
    place = np.clip(np.searchsorted(edges, run.curve_steps, side="left") - 1, 0, len(values) - 1)
    counts = np.bincount(place, minlength=len(values))
    sums = np.bincount(place, run.curve_returns, minlength=len(values))
    filled = np.flatnonzero(counts)
    between = np.arange(filled[0], filled[-1] + 1)
    values[between] = np.interp(between, filled, sums[filled] / counts[filled])
    return values


def draw_curves(groups: Sequence[Group], path: Path) -> None:
    """Write the picture: lines for means, bands for spreads, thin lines for seeds, marks for evaluations."""
    tasks = list(dict.fromkeys(group.task for group in groups))
    figure = Figure(figsize=(1.0 + 6.5 * len(tasks), 4.8), layout="constrained")
    panels = figure.subplots(1, len(tasks), squeeze=False)[0]
    for axes, task in zip(panels, tasks, strict=True):
        for index, group in enumerate(group for group in groups if group.task == task):
            _draw_group(axes, group, index)
        axes.set_title(task)
        axes.set_xlabel("environment steps")
        axes.set_ylabel("true return of an episode")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize="small", loc="best")
    figure.suptitle(
        "Returns while training: mean and standard deviation over seeds, thin lines single seeds; "
        "marks: evaluations with mean actions",
        fontsize="small",
    )
    figure.savefig(path, dpi=130)


def _draw_group(axes: Axes, group: Group, index: int) -> None:
    drawn, seeds = style(index), len(group.runs)
    # For the legend alone: one entry for line and marks.
    label = f"{group.label} ({seeds} seed{'s' if seeds > 1 else ''})"
    axes.plot([], [], color=drawn.colour, linestyle=drawn.dashes, marker=drawn.mark, markersize=5, label=label)
    if any(len(run.curve_steps) for run in group.runs):
        curves = seed_curves(group.runs)
        whole = curves.whole()
        steps, returns = curves.steps[whole], curves.returns[:, whole]
        mean, spread = returns.mean(axis=0), returns.std(axis=0, ddof=min(1, len(returns) - 1))
        axes.plot(steps, mean, color=drawn.colour, linestyle=drawn.dashes, linewidth=1.8)
        axes.fill_between(steps, mean - spread, mean + spread, color=drawn.colour, alpha=0.15, linewidth=0)
        axes.plot(curves.steps, curves.returns.T, color=drawn.colour, linewidth=0.5, alpha=0.4)
    evaluated = [(one.steps, one.mean) for run in group.runs for one in run.evaluations]
    axes.plot(*np.array(evaluated).reshape(-1, 2).T, drawn.mark, markersize=5, color=drawn.colour)


def _short(steps: float) -> str:
    """1.5M, 400k."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if steps >= size:
            return f"{steps / size:g}{letter}"
    return f"{steps:g}"
