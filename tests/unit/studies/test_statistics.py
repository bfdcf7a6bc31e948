"""Against values from printed tables and from counting by hand."""

import math

import numpy as np
import pytest

from mapt.studies.statistics import (
    PairDifferences,
    binomial_p,
    bootstrap_interval,
    mcnemar,
    paired_test,
    student_p,
)


@pytest.mark.parametrize(
    ("t", "degrees", "p"),
    # Student's table, two-sided.
    [
        (12.706, 1, 0.05),
        (4.303, 2, 0.05),
        (3.182, 3, 0.05),
        (2.776, 4, 0.05),
        (2.571, 5, 0.05),
        (2.228, 10, 0.05),
        (2.262, 9, 0.05),
        (63.657, 1, 0.01),
        (9.925, 2, 0.01),
        (4.032, 5, 0.01),
        (2.042, 30, 0.05),
    ],
)
def test_student_agrees_with_the_printed_table(t, degrees, p):
    assert student_p(t, degrees) == pytest.approx(p, rel=2e-3)
    assert student_p(-t, degrees) == student_p(t, degrees)


def test_student_with_one_degree_is_cauchy():
    assert student_p(1.0, 1) == pytest.approx(0.5)
    assert student_p(0.0, 7) == pytest.approx(1.0)


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


def test_the_sign_test_of_thousands_does_not_overflow():
    assert binomial_p(2500, 5000) == 1.0
    # The normal approximation, with its correction by half a head.
    assert binomial_p(2500 - 141, 5000) == pytest.approx(7.07e-5, rel=0.01)


def differences(mean: float, n_segments: int, n_pairs: int, seed: int) -> PairDifferences:
    rng = np.random.default_rng(seed)
    pairs = np.stack([rng.choice(n_segments, 2, replace=False) for _ in range(n_pairs)])
    signs = np.where(rng.random(n_pairs) < 0.2, np.where(rng.random(n_pairs) < 0.5 + mean / 0.4, 1.0, -1.0), 0.0)
    return PairDifferences(signs, pairs)


def test_the_interval_holds_the_mean_and_leaves_out_0_where_the_gain_is_clear():
    tested = [differences(0.1, 200, 1500, seed) for seed in range(2)]
    mean = np.mean([one.difference.mean() for one in tested])
    low, high = bootstrap_interval(tested)
    assert 0 < low < mean < high < 0.2


def test_pairs_that_share_segments_give_a_wider_interval():
    rng = np.random.default_rng(0)
    worth = rng.normal(size=40)
    pairs = np.stack([rng.choice(40, 2, replace=False) for _ in range(3000)])
    tested = PairDifferences(np.sign(worth[pairs[:, 0]] + worth[pairs[:, 1]]), pairs)
    low, high = bootstrap_interval([tested])
    if_pairs_were_independent = 2 * 1.96 * tested.difference.std() / math.sqrt(3000)
    assert high - low > 2 * if_pairs_were_independent


def test_the_interval_is_the_same_every_time():
    tested = [differences(0.0, 100, 500, 0)]
    assert bootstrap_interval(tested) == bootstrap_interval(tested)
