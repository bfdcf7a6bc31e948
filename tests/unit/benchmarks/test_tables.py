"""Summaries and tables of results written by hand."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest

from mapt.benchmarks.evaluate import ModelEvaluation
from mapt.benchmarks.figures import draw_table
from mapt.benchmarks.job import Cell, CellSettings, TablePlan
from mapt.benchmarks.tables import grid, markdown, summarise, write_cells, write_comparisons
from mapt.errors import InvalidConfig

PLAN = TablePlan("Tiny", ("MA-MLP", "MAPT"), ("oracle", "phase"), (100, 500), (0, 1, 2), "small", 10, "cpu", "MA-MLP")
PAIRS = np.arange(20).reshape(10, 2)


def cell(model: str, seed: int, n_correct: int, *, labels: int = 100, teacher: str = "oracle", code: str = "a") -> Cell:
    """A cell that predicts the first `n_correct` of 10 test pairs correctly."""
    settings = CellSettings("Tiny", "f", model, {}, {}, teacher, {}, labels, seed, 10)
    logits = np.where(np.arange(10) < n_correct, 1.0, -1.0).astype(np.float32)
    metrics = {"accuracy": n_correct / 10, "loss": 0.5, "seconds": 60.0}
    return Cell(settings, ModelEvaluation(metrics, logits, np.ones(10), np.ones(10), PAIRS), code)


THREE_SEEDS = [
    *(cell("MA-MLP", seed, n_correct) for seed, n_correct in enumerate((5, 6, 7))),
    *(cell("MAPT", seed, n_correct) for seed, n_correct in enumerate((6, 8, 10))),
]


def test_mean_and_deviation_are_over_seeds():
    accuracy = summarise(PLAN, THREE_SEEDS).line("oracle", 100, "MA-MLP").metrics["accuracy"]
    assert (accuracy.mean, accuracy.std, accuracy.n) == pytest.approx((0.6, 0.1, 3))


def test_the_comparison_is_paired_by_seed_and_by_pair():
    comparison = summarise(PLAN, reversed(THREE_SEEDS)).line("oracle", 100, "MAPT").comparison
    # Gains of 1, 2 and 3 pairs of 10: mean 0.2, deviation 0.1, t = 3.4641.
    assert comparison.over_seeds.mean == pytest.approx(0.2)
    assert comparison.over_seeds.p == pytest.approx(1 - math.sqrt(12 / 14))
    assert (comparison.over_pairs.gained, comparison.over_pairs.lost) == (6, 0)
    assert comparison.over_pairs.p == pytest.approx(2 / 64)
    assert comparison.interval[0] < 0.2 < comparison.interval[1]


def test_only_common_seeds_are_compared():
    cells = [cell("MA-MLP", 0, 5), cell("MAPT", 0, 7), cell("MAPT", 1, 10)]
    comparison = summarise(PLAN, cells).line("oracle", 100, "MAPT").comparison
    assert (comparison.over_seeds.n, comparison.over_seeds.mean) == (1, pytest.approx(0.2))


def test_ties_are_not_compared():
    tied = np.where(np.arange(10) < 5, 0.5, 1.0)
    cells = [
        replace(one, result=replace(one.result, clean_labels=tied))
        for one in (cell("MA-MLP", 0, 5), cell("MAPT", 0, 10))
    ]
    comparison = summarise(PLAN, cells).line("oracle", 100, "MAPT").comparison
    assert comparison.over_seeds.mean == 1.0


def test_missing_results_have_empty_cells():
    summary = summarise(PLAN, THREE_SEEDS)
    assert summary.missing == 2 * 2 * 2 * 3 - 6
    text = markdown(summary)
    assert "18 results are missing" in text
    assert "| MA-MLP | 60.0 ± 10.0 |  |" in text
    (row,) = [line for line in text.partition("### phase, 500 labels")[2].splitlines() if line.startswith("| MAPT")]
    assert set(row.removeprefix("| MAPT")) <= {"|", " "}


def test_the_markdown_shows_the_difference_and_its_tests():
    text = markdown(summarise(PLAN, THREE_SEEDS)).partition("### oracle, 100 labels")[2]
    (row,) = [line for line in text.splitlines() if line.startswith("| MAPT") and "+20.00" in line]
    assert "0.074" in row
    assert "0.031" in row
    assert row.endswith("| 3 |")


def test_an_arrow_shows_a_difference_beyond_chance():
    cells = [cell(model, seed, n_correct) for seed in (0, 1) for model, n_correct in (("MA-MLP", 2), ("MAPT", 9))]
    assert "| MAPT | 90.0 ± 0.0 ▲ |" in markdown(summarise(PLAN, cells))
    swapped = [cell(model, seed, n_correct) for seed in (0, 1) for model, n_correct in (("MA-MLP", 9), ("MAPT", 2))]
    assert "| MAPT | 20.0 ± 0.0 ▼ |" in markdown(summarise(PLAN, swapped))
    assert "| MAPT | 30.0 |" in markdown(summarise(PLAN, [cell("MA-MLP", 0, 2), cell("MAPT", 0, 3)]))


def test_the_markdown_warns_of_results_from_several_versions_of_the_code():
    assert "versions of the code" not in markdown(summarise(PLAN, THREE_SEEDS))
    assert "2 versions of the code" in markdown(
        summarise(PLAN, [*THREE_SEEDS, cell("MAPT", 0, 5, labels=500, code="b")])
    )


def test_csv_files_have_a_line_per_cell_and_per_comparison(tmp_path):
    summary = summarise(PLAN, THREE_SEEDS)
    write_cells(summary, tmp_path / "cells.csv")
    write_comparisons(summary, tmp_path / "comparisons.csv")
    cells = list(csv.DictReader((tmp_path / "cells.csv").read_text().splitlines()))
    assert [(row["model"], row["seed"], row["accuracy"]) for row in cells[:2]] == [
        ("MA-MLP", "0", "0.5"),
        ("MA-MLP", "1", "0.6"),
    ]
    (comparison,) = csv.DictReader((tmp_path / "comparisons.csv").read_text().splitlines())
    assert (comparison["model"], comparison["gained"], comparison["lost"]) == ("MAPT", "6", "0")
    assert float(comparison["difference"]) == pytest.approx(0.2)


@pytest.mark.parametrize("cells", [THREE_SEEDS, [], [cell("MAPT", 0, 10)]], ids=["six cells", "no cells", "one cell"])
def test_an_incomplete_table_can_be_plotted(tmp_path, cells):
    draw_table(summarise(PLAN, cells), tmp_path / "table.png")
    assert (tmp_path / "table.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "changes",
    [
        *({"models": ()}, {"seeds": (0, 0)}, {"labels": (1,)}, {"baseline": "MA-LSTM"}, {"test_pairs": 0}),
        {"pair_distance": 1.1},
    ],
)
def test_an_invalid_plan_is_refused(changes):
    with pytest.raises(InvalidConfig):
        replace(PLAN, **changes)


def test_a_separator_within_a_cell_is_escaped():
    assert grid(["task"], [["Humanoid-9|8"]]).splitlines()[-1] == "| Humanoid-9\\|8 |"
