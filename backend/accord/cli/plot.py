"""True return by steps, from a demo's results: `python -m accord.cli.plot results.json returns.png`."""

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")

from matplotlib import pyplot as plt

#: as in the clips: told apart with any colour vision
_COLOURS = {"preferences": "#0072B2", "true": "#D55E00"}
_LABELS = {"preferences": "labels alone", "true": "true reward"}


def draw(results: Path, picture: Path) -> None:
    """Draw one line per run; reward versions as marks on the line of their run."""
    runs: list[dict[str, Any]] = json.loads(results.read_text())["runs"]
    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    named: set[str] = set()
    for run in runs:
        source = run["plan"]["reward_source"]
        points = run["curves"].get("true_return", [])
        steps, returns = [step for step, _ in points], [value for _, value in points]
        label = None if source in named else _LABELS[source]
        named.add(source)
        axes.plot(steps, returns, color=_COLOURS[source], alpha=0.8, label=label)
        _mark_versions(axes, run, points)
        axes.plot([run["steps"]], [run["final"]], marker="*", markersize=11, color=_COLOURS[source], linestyle="none")
    axes.axhline(runs[0]["untrained"], color="#8D99A6", linestyle=":", label="untrained")
    axes.set_xlabel("environment steps")
    axes.set_ylabel("true return of an episode")
    axes.set_title(f"{runs[0]['plan']['task']}: dots are reward versions, stars the last policy's mean actions")
    axes.legend()
    figure.savefig(picture, dpi=120)
    plt.close(figure)


def _mark_versions(axes: Any, run: dict[str, Any], points: list[list[float]]) -> None:
    for version in run["versions"]:
        # On the line, between the two episodes' ends about it.
        steps, returns = np.array(points, dtype=float).reshape(-1, 2).T
        height = np.interp(version["policy_steps"], steps, returns) if points else run["untrained"]
        axes.plot([version["policy_steps"]], [height], marker="o", markersize=4, color=_COLOURS["preferences"])


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
