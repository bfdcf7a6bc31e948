"""True return by steps, and by labels, from a demo's results: `python -m accord.cli.plot results.json returns.png`."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

mpl.use("Agg")

from matplotlib import pyplot as plt

from accord.cli.demo_runs import PREFERENCES
from mapt.plotting import QUIET, Style, style
from mapt.training.results import deviation, seed_curves

Run = dict[str, Any]
#: so many kinds of runs leave room for marks on their lines
_FEW_KINDS = 3
#: how far the marks of two models stand apart, as a share of the labels
_ASIDE = 0.02


class Curve(NamedTuple):
    """See `mapt.training.results.Curve`."""

    curve_steps: NDArray[np.int64]
    curve_returns: NDArray[np.float64]


def draw(results: Path, picture: Path) -> None:
    """Draw one line per run, with reward versions as marks on it; beside it returns by labels, if these differ.

    Of many kinds of runs the means are drawn, one line for each kind: single runs would hide each other.
    """
    runs: list[Run] = json.loads(results.read_text())["runs"]
    kinds = list(dict.fromkeys(_kind(run) for run in sorted(runs, key=_order)))
    styles = {kind: style(number) for number, kind in enumerate(kinds)}
    several = len({run["plan"]["label_budget"] for run in runs if _learned(run)}) > 1
    figure, panels = plt.subplots(1, 1 + several, figsize=(8 + 5 * several, 5), layout="constrained", squeeze=False)
    if len(kinds) <= _FEW_KINDS:
        _draw_runs(panels[0, 0], runs, styles)
        lines = "dots are reward versions"
    else:
        _draw_means(panels[0, 0], runs, styles)
        lines = "lines are means over seeds"
    if several:
        _draw_labels(panels[0, 1], runs)
    figure.suptitle(f"{runs[0]['plan']['task']}: {lines}, stars the last policy's mean actions")
    figure.savefig(picture, dpi=120)
    plt.close(figure)


def _learned(run: Run) -> bool:
    return run["plan"]["reward_source"] == PREFERENCES


def _kind(run: Run) -> str:
    return f"{run['plan']['reward_model']}, {run['plan']['label_budget']:,} labels" if _learned(run) else "true reward"


def _order(run: Run) -> tuple[bool, int, str]:
    """The true reward first, then by labels."""
    return _learned(run), run["plan"]["label_budget"], run["plan"]["reward_model"]


def _draw_runs(axes: Any, runs: Sequence[Run], styles: dict[str, Style]) -> None:
    named: set[str] = set()
    for run in runs:
        kind, drawn, (steps, returns) = _kind(run), styles[_kind(run)], _curve(run)
        label = None if kind in named else kind
        axes.plot(steps, returns, linestyle=drawn.dashes, color=drawn.colour, alpha=0.8, label=label)
        named.add(kind)
        for version in run["versions"]:
            # On the line, between the two episodes' ends about it.
            height = np.interp(version["policy_steps"], steps, returns) if len(steps) else run["untrained"]
            axes.plot([version["policy_steps"]], [height], marker="o", markersize=4, color=drawn.colour)
        _draw_star(axes, run["steps"], run["final"], drawn)
    _finish(axes, runs)


def _draw_means(axes: Any, runs: Sequence[Run], styles: dict[str, Style]) -> None:
    for kind, drawn in styles.items():
        alike = [run for run in runs if _kind(run) == kind]
        if begun := [curve for run in alike if len((curve := _curve(run)).curve_steps)]:
            curves = seed_curves(begun)
            whole = curves.whole()
            means = curves.returns[:, whole].mean(axis=0)
            axes.plot(curves.steps[whole], means, linestyle=drawn.dashes, color=drawn.colour)
        # For the legend alone: a kind whose runs have no episode yet is named too.
        axes.plot([], [], linestyle=drawn.dashes, color=drawn.colour, label=kind)
        _draw_star(axes, max(run["steps"] for run in alike), float(np.mean([run["final"] for run in alike])), drawn)
    _finish(axes, runs)


def _curve(run: Run) -> Curve:
    points = np.array(run["curves"].get("true_return", [])).reshape(-1, 2)
    return Curve(points[:, 0].astype(np.int64), points[:, 1])


def _draw_star(axes: Any, steps: int, final: float, drawn: Style) -> None:
    axes.plot([steps], [final], marker="*", markersize=11, color=drawn.colour, linestyle="none")


def _finish(axes: Any, runs: Sequence[Run]) -> None:
    axes.axhline(runs[0]["untrained"], color=QUIET, linestyle=":", label="untrained")
    axes.set_xlabel("environment steps")
    axes.set_ylabel("true return of an episode")
    axes.legend(fontsize="small")


def _draw_labels(axes: Any, runs: Sequence[Run]) -> None:
    """Means over seeds with their standard deviation, and each seed's value."""
    models = list(dict.fromkeys(run["plan"]["reward_model"] for run in runs if _learned(run)))
    for number, model in enumerate(models):
        drawn, found = style(number + 1), {}
        for run in runs:
            if _learned(run) and run["plan"]["reward_model"] == model:
                found.setdefault(run["plan"]["label_budget"], []).append(run["final"])
        labels = sorted(found)
        shifted = np.array(labels) * (1 + _ASIDE * number)
        means, spreads = ([function(found[count]) for count in labels] for function in (np.mean, deviation))
        axes.errorbar(shifted, means, spreads, fmt=f"{drawn.mark}-", color=drawn.colour, capsize=3, label=model)
        for place, count in zip(shifted, labels, strict=True):
            axes.plot([place] * len(found[count]), found[count], ".", color=drawn.colour, alpha=0.5)
    true = [run["final"] for run in runs if not _learned(run)]
    if true:
        middle, spread = float(np.mean(true)), deviation(true)
        axes.axhline(middle, color=style(0).colour, label="true reward")
        axes.axhspan(middle - spread, middle + spread, color=style(0).colour, alpha=0.1)
    axes.set_xlabel("labels")
    axes.set_ylabel("true return of the last policy's mean actions")
    axes.legend(fontsize="small")


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
