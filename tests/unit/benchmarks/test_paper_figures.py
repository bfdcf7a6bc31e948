"""The figure of scores, from rows with known scores."""

import pytest
from matplotlib.figure import Figure

from mapt.benchmarks.paper_figures import draw_scores
from mapt.benchmarks.paper_tables import Row

TASK = "HalfCheetah-6x1"


def row(reward: str, pairs: int, *scores: float) -> Row:
    by_seed = dict(enumerate(scores))
    return Row(TASK, "mappo", reward, pairs, by_seed, {TASK: by_seed})


def test_scores_are_drawn_at_their_numbers_of_pairs_with_their_intervals():
    axes = Figure().subplots()
    # Two seeds resample to their values or their mean; one seed has no interval.
    rows = [row("MAPT", 500, 0.5, 0.75), row("MAPT", 2000, 0.9), row("MA-MLP", 500), row("MA-MLP", 2000, 0.2, 0.4)]
    draw_scores(axes, rows, ["MAPT", "MA-MLP", "MAPT*"])
    handles, labels = axes.get_legend_handles_labels()
    assert sorted(labels) == ["MA-MLP", "MAPT", "MAPT*", "true reward"]
    drawn = dict(zip(labels, handles, strict=True))
    assert drawn["true reward"].get_ydata()[0] == 1
    for model, points, bars in (
        ("MAPT", [(500, 0.625), (2000, 0.9)], [[0.5, 0.75], []]),
        ("MA-MLP", [(2000, 0.3)], [[0.2, 0.4]]),
        ("MAPT*", [], []),
    ):
        line, _, (segments,) = drawn[model]
        assert line.get_ydata() == pytest.approx([score for _, score in points])
        # Models with the same number of pairs are drawn side by side.
        assert line.get_xdata() == pytest.approx([pairs for pairs, _ in points], rel=0.1)
        drawn_bars = [[score for _, score in segment] for segment in segments.get_segments()]
        assert drawn_bars == [pytest.approx(bar) for bar in bars]
