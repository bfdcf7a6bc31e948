"""Statistical tests and intervals, compared with values computed by hand."""

import math

import numpy as np
import pytest

from mapt.benchmarks.statistics import (
    PairDifferences,
    difference_interval,
    interquartile_mean_with_interval,
    mcnemar,
    paired_test,
)


def test_paired_test_over_three_seeds():
    # mean 2, deviation 1, t = 2 / (1 / sqrt 3) = 3.4641; p = 1 - t / sqrt(2 + t^2) with two degrees.
    result = paired_test([1.0, 2.0, 3.0])
    assert (result.n, result.mean, result.deviation) == (3, 2.0, 1.0)
    assert result.p == pytest.approx(1 - math.sqrt(12 / 14))


def test_paired_test_of_one_difference_has_no_deviation_and_no_p():
    result = paired_test([0.5])
    assert (result.n, result.mean) == (1, 0.5)
    assert math.isnan(result.deviation)
    assert math.isnan(result.p)


def test_equal_differences_have_p_1_if_zero_and_p_0_otherwise():
    assert paired_test([0.0, 0.0, 0.0]).p == 1.0
    assert paired_test([0.25, 0.25, 0.25]).p == 0.0


def test_mcnemar_counts_only_pairs_on_which_the_models_differ():
    right = [True] * 5 + [False] * 1 + [True] * 90 + [False] * 4
    baseline = [False] * 5 + [True] * 1 + [True] * 90 + [False] * 4
    result = mcnemar(right, baseline)
    assert (result.gained, result.lost) == (5, 1)
    # (1 + 6) of 64 sequences of 6 throws have at most one head; the test is two-sided.
    assert result.p == pytest.approx(14 / 64)


def test_mcnemar_of_models_that_agree_has_p_1():
    assert mcnemar([True, False], [True, False]).p == 1.0


def standard_error(tested: PairDifferences) -> float:
    low, high = difference_interval([tested])
    return (high - low) / 2 / 1.959964


def test_pairs_without_a_common_segment_are_independent():
    tested = PairDifferences(np.array([1.0, 0.0, -1.0, 1.0, 1.0, 0.0]), np.arange(12).reshape(6, 2))
    # Mean 1/3; squared residuals 4/9 * 3 + 1/9 * 2 + 16/9 = 30/9.
    assert standard_error(tested) == pytest.approx(math.sqrt(30 / 9) / 6)


def test_pairs_with_a_common_segment_are_correlated():
    # Two groups of three pairs that share a segment. The residuals are 1 in one group and -1 in the other, so the
    # variance of the mean is (3^2 + 3^2) / 6^2.
    pairs = np.array([[0, 1], [2, 0], [0, 3], [4, 5], [4, 6], [7, 4]])
    tested = PairDifferences(np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0]), pairs)
    assert standard_error(tested) == pytest.approx(math.sqrt(18) / 6)


def test_the_interval_narrows_with_the_number_of_seeds():
    one = PairDifferences(np.array([1.0, 0.0, -1.0, 1.0]), np.arange(8).reshape(4, 2))
    low, high = difference_interval([one])
    both = difference_interval([one, one])
    assert both[1] - both[0] == pytest.approx((high - low) / math.sqrt(2))
    assert (both[0] + both[1]) / 2 == pytest.approx(0.25)


def test_the_interval_covers_the_true_difference_in_95_of_100_samples():
    rng = np.random.default_rng(0)
    n_covered = 0
    for _ in range(500):
        # A difference is the sum of effects of its two segments, which other pairs share, and of independent noise.
        effects = 0.5 * rng.normal(size=150)
        pairs = np.argsort(rng.random((1500, 150)), axis=1)[:, :2]
        difference = 0.2 + effects[pairs].sum(axis=1) + rng.normal(size=1500)
        low, high = difference_interval([PairDifferences(difference, pairs)])
        n_covered += low < 0.2 < high
    assert 0.91 < n_covered / 500 < 0.98


def test_models_that_never_differ_have_an_empty_interval_at_0():
    assert difference_interval([PairDifferences(np.zeros(4), np.arange(8).reshape(4, 2))]) == (0.0, 0.0)


def test_the_interquartile_mean_is_taken_over_all_samples():
    # Of eight values, the lowest and the highest two are left out.
    found = interquartile_mean_with_interval([[-100.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 100.0]])
    assert found.value == pytest.approx(3.5)
    assert found.low < found.value < found.high


def test_the_bootstrap_resamples_within_each_sample():
    # Every resample has two zeros and two ones, so the interval has no width.
    found = interquartile_mean_with_interval([[0.0, 0.0], [1.0, 1.0]])
    assert (found.value, found.low, found.high) == (0.5, 0.5, 0.5)


def test_a_sample_of_one_value_has_no_interval():
    found = interquartile_mean_with_interval([[2.0]])
    assert found.value == 2.0
    assert math.isnan(found.low)
    assert math.isnan(found.high)
