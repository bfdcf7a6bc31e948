"""Against values from printed tables and from counting by hand."""

import math

import numpy as np
import pytest

from mapt.benchmarks.statistics import (
    PairDifferences,
    difference_interval,
    mcnemar,
    paired_test,
)


def test_differences_over_three_seeds():
    # mean 2, deviation 1, t = 2 / (1 / sqrt 3) = 3.4641; p = 1 - t / sqrt(2 + t^2) with two degrees.
    found = paired_test([1.0, 2.0, 3.0])
    assert (found.n, found.mean, found.deviation) == (3, 2.0, 1.0)
    assert found.p == pytest.approx(1 - math.sqrt(12 / 14))


def test_one_difference_says_nothing_of_its_spread():
    found = paired_test([0.5])
    assert (found.n, found.mean) == (1, 0.5)
    assert math.isnan(found.deviation)
    assert math.isnan(found.p)


def test_equal_differences():
    assert paired_test([0.0, 0.0, 0.0]).p == 1.0
    assert paired_test([0.25, 0.25, 0.25]).p == 0.0


def test_mcnemar_counts_only_pairs_on_which_the_models_differ():
    right = [True] * 5 + [False] * 1 + [True] * 90 + [False] * 4
    baseline = [False] * 5 + [True] * 1 + [True] * 90 + [False] * 4
    found = mcnemar(right, baseline)
    assert (found.gained, found.lost) == (5, 1)
    # (1 + 6) of 64 throws have at most one head; twice that.
    assert found.p == pytest.approx(14 / 64)


def test_models_that_agree_do_not_differ():
    assert mcnemar([True, False], [True, False]).p == 1.0


def standard_error(tested: PairDifferences) -> float:
    low, high = difference_interval([tested])
    return (high - low) / 2 / 1.959964


def test_pairs_without_a_common_segment_are_independent():
    tested = PairDifferences(np.array([1.0, 0.0, -1.0, 1.0, 1.0, 0.0]), np.arange(12).reshape(6, 2))
    # Mean 1/3; squared residuals 4/9 * 3 + 1/9 * 2 + 16/9 = 30/9.
    assert standard_error(tested) == pytest.approx(math.sqrt(30 / 9) / 6)


def test_pairs_with_a_common_segment_count_together():
    # Two stars: the three pairs of each share a segment and agree. Residuals are 1, -1: (3^2 + 3 - 3) of each, / 6^2.
    pairs = np.array([[0, 1], [2, 0], [0, 3], [4, 5], [4, 6], [7, 4]])
    tested = PairDifferences(np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0]), pairs)
    assert standard_error(tested) == pytest.approx(math.sqrt(18) / 6)


def test_the_mean_over_seeds_is_surer_than_that_of_one():
    one = PairDifferences(np.array([1.0, 0.0, -1.0, 1.0]), np.arange(8).reshape(4, 2))
    low, high = difference_interval([one])
    both = difference_interval([one, one])
    assert both[1] - both[0] == pytest.approx((high - low) / math.sqrt(2))
    assert (both[0] + both[1]) / 2 == pytest.approx(0.25)


def test_the_interval_holds_the_truth_95_times_in_100():
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(500):
        # What a segment does to the difference, shared by all its pairs, and what a pair does by itself.
        worth = 0.5 * rng.normal(size=150)
        pairs = np.argsort(rng.random((1500, 150)), axis=1)[:, :2]
        difference = 0.2 + worth[pairs].sum(axis=1) + rng.normal(size=1500)
        low, high = difference_interval([PairDifferences(difference, pairs)])
        held += low < 0.2 < high
    assert 0.91 < held / 500 < 0.98


def test_models_that_never_differ_have_an_interval_of_0():
    assert difference_interval([PairDifferences(np.zeros(4), np.arange(8).reshape(4, 2))]) == (0.0, 0.0)
