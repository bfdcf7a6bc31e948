"""Curves of true return over steps: mean and spread over seeds, one panel for each task."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from mapt.plotting import style
from mapt.training.results import Group, deviation, seed_curves


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
        mean, spread = returns.mean(axis=0), deviation(returns)
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
