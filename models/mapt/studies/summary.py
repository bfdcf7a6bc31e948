"""A table's lines from its finished cells: means, spreads, and tests against the baseline."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean, stdev

import numpy as np
from numpy.typing import NDArray

from mapt.studies.cell_folder import Cell
from mapt.studies.plan import TablePlan
from mapt.studies.statistics import McNemar, PairDifferences, PairedTest, difference_interval, mcnemar, paired_test


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
