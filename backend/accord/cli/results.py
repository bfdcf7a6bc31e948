"""What a demo leaves behind: a table, JSON, CSV and a plot."""

import csv
import json
import math
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from rich.table import Table

from accord.cli.demo_runs import PREFERENCES, TRUE, RunResult

RESULTS, CURVES, PLOT = "results.json", "curves.csv", "returns.png"


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table: true returns of one seed, or their mean over seeds."""

    reward_model: str
    labels: float
    seed: str
    untrained: float
    #: the same learner on the task's own reward; NaN without a baseline
    true_reward: float
    learned_reward: float
    versions: float
    seconds: float
    #: standard deviation of `learned_reward` over seeds; NaN for one
    spread: float = math.nan

    @property
    def share(self) -> float:
        """What part of the true-reward learner's return labels alone gave; NaN where that return is not positive."""
        return self.learned_reward / self.true_reward if self.true_reward > 0 else math.nan


def rows_of(results: Sequence[RunResult]) -> list[Row]:
    """For each reward model and number of labels, one row per seed, and one of means where there are several."""
    true = {result.plan.seed: result.final for result in results if result.plan.reward_source == TRUE}
    kinds: dict[tuple[int, str], list[Row]] = {}
    for result in results:
        if result.plan.reward_source == PREFERENCES:
            row = Row(
                result.plan.reward_model,
                result.labels,
                str(result.plan.seed),
                result.untrained,
                true.get(result.plan.seed, math.nan),
                result.final,
                len(result.versions),
                result.seconds,
            )
            kinds.setdefault((result.plan.label_budget, result.plan.reward_model), []).append(row)
    return [row for _, rows in sorted(kinds.items()) for row in (rows if len(rows) == 1 else [*rows, _mean(rows)])]


def _mean(rows: Sequence[Row]) -> Row:
    names = ("labels", "untrained", "true_reward", "learned_reward", "versions", "seconds")
    means = {name: mean(getattr(row, name) for row in rows) for name in names}
    return Row(rows[0].reward_model, seed="mean", spread=stdev(row.learned_reward for row in rows), **means)


def table(rows: Sequence[Row], title: str) -> Table:
    """For the terminal."""
    made = Table(title=title)
    made.add_column("reward model")
    for heading in ("labels", "seed", "untrained", "true reward", "learned reward", "share", "versions", "minutes"):
        made.add_column(heading, justify="right")
    for row in rows:
        made.add_row(
            row.reward_model,
            _number(row.labels),
            row.seed,
            _number(row.untrained),
            _number(row.true_reward),
            _number(row.learned_reward) + ("" if math.isnan(row.spread) else f" ± {_number(row.spread)}"),
            "-" if math.isnan(row.share) else f"{row.share:.0%}",
            _number(row.versions),
            f"{row.seconds / 60:.1f}",
            end_section=row.seed == "mean",
        )
    return made


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:,.0f}"


def write(folder: Path, results: Sequence[RunResult]) -> list[Path]:
    """Write results, curves and the plot into `folder`. Returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / RESULTS, folder / CURVES, folder / PLOT]
    paths[0].write_text(json.dumps(_document(results), indent=1, allow_nan=False) + "\n")
    with paths[1].open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(("seed", "reward", "reward_model", "labels", "curve", "step", "value"))
        for result in results:
            plan = result.plan
            learned = plan.reward_source == PREFERENCES
            kind = (plan.reward_model, plan.label_budget) if learned else ("", "")
            for name, points in result.curves.items():
                lines.writerows((plan.seed, plan.reward_source, *kind, name, step, value) for step, value in points)
    # In a process of its own: matplotlib takes longer to import than most commands take to run.
    subprocess.run([sys.executable, "-m", "accord.cli.plot", str(paths[0]), str(paths[2])], check=True)
    return paths


def _document(results: Sequence[RunResult]) -> dict[str, Any]:
    return {
        "machine": platform.machine(),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("torch", "mujoco", "numpy")},
        },
        "runs": [result.to_dict() for result in results],
    }
