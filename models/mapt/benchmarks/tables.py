"""A table's lines from its finished cells: means, spreads, and tests against the baseline."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev

import numpy as np
from numpy.typing import NDArray

from mapt.benchmarks.job import Cell, TablePlan
from mapt.benchmarks.statistics import McNemar, PairDifferences, PairedTest, difference_interval, mcnemar, paired_test


@dataclass(frozen=True, slots=True)
class Spread:
    """One number over seeds."""

    mean: float
    #: sample standard deviation; NaN with one seed
    deviation: float
    n: int


@dataclass(frozen=True, slots=True)
class Comparison:
    """A model's accuracy less the baseline's, on the same seeds and the same fresh pairs."""

    #: over seeds
    over_seeds: PairedTest
    #: 95%, see `difference_interval`
    interval: tuple[float, float]
    #: over the fresh pairs of all seeds
    over_pairs: McNemar


@dataclass(frozen=True, slots=True)
class Line:
    """A model with one teacher and one number of labels."""

    teacher: str
    labels: int
    model: str
    #: by metric, see `run_cell`; empty where no cell is finished
    metrics: Mapping[str, Spread]
    #: None for the baseline itself, and where no seed has both
    comparison: Comparison | None


@dataclass(frozen=True, slots=True)
class Summary:
    """A whole table."""

    plan: TablePlan
    lines: tuple[Line, ...]
    cells: tuple[Cell, ...]

    def line(self, teacher: str, labels: int, model: str) -> Line:
        """The line of these three."""
        return next(line for line in self.lines if (line.teacher, line.labels, line.model) == (teacher, labels, model))

    @property
    def missing(self) -> int:
        """Cells that are not finished."""
        plan = self.plan
        wanted = len(plan.models) * len(plan.teachers) * len(plan.labels) * len(plan.seeds)
        return wanted - len(self.cells)

    @property
    def codes(self) -> tuple[str, ...]:
        """States of the code that made the cells."""
        return tuple(sorted({cell.code for cell in self.cells}))


def summarise(plan: TablePlan, cells: Iterable[Cell]) -> Summary:
    """Gather finished cells of `plan` into its table."""
    finished = tuple(cells)
    by_line: dict[tuple[str, int, str], list[Cell]] = {}
    for cell in finished:
        settings = cell.settings
        by_line.setdefault((settings.teacher, settings.labels, settings.model), []).append(cell)
    lines = tuple(
        Line(
            teacher,
            labels,
            model,
            spreads(by_line.get((teacher, labels, model), [])),
            None
            if model == plan.baseline
            else compare(by_line.get((teacher, labels, model), []), by_line.get((teacher, labels, plan.baseline), [])),
        )
        for teacher in plan.teachers
        for labels in sorted(plan.labels)
        for model in plan.models
    )
    return Summary(plan, lines, finished)


def spreads(cells: Sequence[Cell]) -> dict[str, Spread]:
    """Mean and spread over cells of each metric that any of them has."""
    values: dict[str, list[float]] = {}
    for cell in cells:
        for name, value in cell.result.metrics.items():
            values.setdefault(name, []).append(value)
    return {
        name: Spread(mean(found), stdev(found) if len(found) > 1 else math.nan, len(found))
        for name, found in values.items()
    }


def compare(cells: Sequence[Cell], baseline: Sequence[Cell]) -> Comparison | None:
    """Compare where both have a cell of the same seed; None if nowhere."""
    others = {cell.settings.seed: cell for cell in baseline}
    both = [(cell, others[cell.settings.seed]) for cell in cells if cell.settings.seed in others]
    if not both:
        return None
    right = [(told_rightly(cell), told_rightly(other)) for cell, other in both]
    tested = [
        PairDifferences(own.astype(np.float64) - other, decided_pairs(cell))
        for (own, other), (cell, _) in zip(right, both, strict=True)
    ]
    return Comparison(
        paired_test([one.difference.mean() for one in tested]),
        difference_interval(tested),
        mcnemar(*(np.concatenate(side) for side in zip(*right, strict=True))),
    )


def told_rightly(cell: Cell) -> NDArray[np.bool_]:
    """Of each fresh pair that is no tie: did the model tell the better segment?"""
    result = cell.result
    decided = result.clean_labels != 0.5
    return ((result.logits > 0) == (result.clean_labels > 0.5))[decided]


def decided_pairs(cell: Cell) -> NDArray[np.int64]:
    """The fresh pairs that are no tie, (P, 2)."""
    return cell.result.pairs[cell.result.clean_labels != 0.5]


#: columns of the full tables: heading, metric, format of the mean, whether to show the spread, factor
_COLUMNS: tuple[tuple[str, str, str, bool, float], ...] = (
    ("accuracy %", "accuracy", ".2f", True, 100),
    ("label accuracy %", "label_accuracy", ".2f", False, 100),
    ("loss", "loss", ".4f", True, 1),
    ("ECE", "ece", ".3f", False, 1),
    ("rank: true return", "rank_correlation", ".3f", True, 1),
    ("late", "rank_correlation_late", ".3f", False, 1),
    ("rank: teacher", "rank_correlation_teacher", ".3f", True, 1),
    ("steps", "step_correlation", ".3f", True, 1),
    ("within", "step_correlation_within", ".3f", False, 1),
    ("minutes", "seconds", ".1f", False, 1 / 60),
    ("CPU minutes", "cpu_seconds", ".1f", False, 1 / 60),
    ("parameters", "parameters", ",.0f", False, 1),
)
_SETTINGS = ("task", "teacher", "labels", "model", "seed")
_COMPARED = (
    *("teacher", "labels", "model", "baseline", "seeds", "difference", "deviation", "p_seeds"),
    *("low", "high", "gained", "lost", "p_pairs"),
)


def markdown(summary: Summary) -> str:
    """The whole table; a cell that is not finished stays empty."""
    plan = summary.plan
    parts = [
        f"# {plan.task}: models by labels and teachers",
        f"Preset `{plan.preset}`; seeds {', '.join(map(str, plan.seeds))}; {plan.test_pairs:,} fresh pairs of segments "
        "that no training pair holds, the same for every model. ± is the standard deviation over seeds. "
        f"Δ is the accuracy less that of {plan.baseline}, in points, with the 95% interval that other test segments "
        "would leave it in, where pairs that share a segment count as going together (▲ and ▼ where it leaves out 0); "
        "`p seeds` is of Student's paired test over seeds, `p pairs` of McNemar's exact test over the pairs of all "
        "seeds as if each were by itself. `accuracy` is of telling the segment that is better by what the teacher "
        "judges by; `label accuracy`, loss and ECE are against the labels it gives. `rank` is Spearman's correlation "
        "of scores with true returns (`late`: over the newest fifth of the segments) and with what the teacher judges "
        "by; `steps` Pearson's of single steps' rewards with the true ones (`within`: after taking away each segment's "
        "mean). Minutes are those of training.",
    ]
    if summary.missing:
        parts.append(f"**{summary.missing} cells are not finished.**")
    if len(summary.codes) > 1:
        parts.append(
            f"**The cells come from {len(summary.codes)} states of the code** (`--same-code` makes them anew)."
        )
    for teacher in plan.teachers:
        parts.append(f"## Teacher: {teacher}\n\n{_overview(summary, teacher)}")
        parts.extend(
            f"### {teacher}, {labels:,} labels\n\n{_full_table(summary, teacher, labels)}"
            for labels in sorted(plan.labels)
        )
    return "\n\n".join(parts) + "\n"


def _overview(summary: Summary, teacher: str) -> str:
    counts = sorted(summary.plan.labels)
    rows = [
        [model, *(_accuracy(summary.line(teacher, labels, model)) for labels in counts)]
        for model in summary.plan.models
    ]
    return _grid(["accuracy %", *(f"{labels:,} labels" for labels in counts)], rows)


def _accuracy(line: Line) -> str:
    return _number(line.metrics.get("accuracy"), ".1f", True, 100) + _star(line.comparison)


def _star(comparison: Comparison | None) -> str:
    """An arrow where the interval of the difference leaves out 0."""
    if comparison is None:
        return ""
    low, high = comparison.interval
    return " ▲" if low > 0 else " ▼" if high < 0 else ""


def _full_table(summary: Summary, teacher: str, labels: int) -> str:
    lines = [summary.line(teacher, labels, model) for model in summary.plan.models]
    shown = [column for column in _COLUMNS if any(column[1] in line.metrics for line in lines)] or [_COLUMNS[0]]
    rows = []
    for line in lines:
        numbers = [_number(line.metrics.get(metric), form, spread, factor) for _, metric, form, spread, factor in shown]
        rows.append([line.model, numbers[0], *_compared(line.comparison), *numbers[1:], _seeds(line)])
    headings = ["model", shown[0][0], "Δ [95%]", "p seeds", "p pairs", *(column[0] for column in shown[1:]), "seeds"]
    return _grid(headings, rows)


def _compared(comparison: Comparison | None) -> list[str]:
    if comparison is None:
        return ["", "", ""]
    low, high = comparison.interval
    return [
        f"{100 * comparison.over_seeds.mean:+.2f} [{100 * low:+.2f}, {100 * high:+.2f}]",
        _p(comparison.over_seeds.p),
        _p(comparison.over_pairs.p),
    ]


def _p(p: float) -> str:
    if math.isnan(p):
        return ""
    return "<0.001" if p < 0.001 else f"{p:.3f}"


def _seeds(line: Line) -> str:
    found = line.metrics.get("accuracy")
    return str(found.n) if found else ""


def _number(spread: Spread | None, form: str, show_spread: bool, factor: float) -> str:
    if spread is None:
        return ""
    text = format(factor * spread.mean, form)
    if show_spread and not math.isnan(spread.deviation):
        text += f" ± {format(factor * spread.deviation, form)}"
    return text


def _grid(headings: list[str], rows: list[list[str]]) -> str:
    ruler = ["---", *("--:" for _ in headings[1:])]
    return "\n".join("| " + " | ".join(row) + " |" for row in [headings, ruler, *rows])


def write_cells(summary: Summary, path: Path) -> None:
    """One line for each finished cell, with every metric."""
    names = sorted({name for cell in summary.cells for name in cell.result.metrics})
    with path.open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow([*_SETTINGS, *names, "code"])
        for cell in summary.cells:
            settings, metrics = cell.settings.to_dict(), cell.result.metrics
            lines.writerow(
                [*(settings[name] for name in _SETTINGS), *(metrics.get(name, "") for name in names), cell.code]
            )


def write_comparisons(summary: Summary, path: Path) -> None:
    """One line for each comparison with the baseline."""
    with path.open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(_COMPARED)
        for line in summary.lines:
            if (found := line.comparison) is not None:
                seeds, pairs = found.over_seeds, found.over_pairs
                settings = (line.teacher, line.labels, line.model, summary.plan.baseline)
                over_seeds = (seeds.n, seeds.mean, seeds.deviation, seeds.p)
                lines.writerow([*settings, *over_seeds, *found.interval, pairs.gained, pairs.lost, pairs.p])
