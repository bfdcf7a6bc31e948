import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import spearmanr

from mapt.rewards.metrics import (
    CalibrationBin,
    accuracy,
    calibrated_losses,
    calibration_bins,
    calibration_error,
    confidence,
    correlation,
    rank_correlation,
)


def test_accuracy_ignores_ties():
    assert accuracy([0.9, 0.2, 0.7, 0.9], [1.0, 1.0, 0.5, 1.0]) == pytest.approx(2 / 3)
    assert math.isnan(accuracy([0.9], [0.5]))
    assert math.isnan(accuracy([], []))


def test_logits_that_are_too_large_are_reduced_to_their_confidence():
    # Three of four predictions are right: the best probability is 0.75, of logit log(3).
    logits, labels = torch.full((400,), 8 * math.log(3)), torch.tensor([1.0, 1.0, 1.0, 0.0] * 100)
    assert confidence(logits, labels) == pytest.approx(1 / 8)
    entropy = -0.75 * math.log(0.75) - 0.25 * math.log(0.25)
    assert calibrated_losses(logits, labels).mean().item() == pytest.approx(entropy)


def test_confidence_is_at_most_one_and_low_for_wrong_predictions():
    labels = torch.tensor([1.0, 0.0])
    assert confidence(torch.tensor([0.1, -0.1]), labels) == 1
    assert calibrated_losses(torch.tensor([-9.0, 9.0]), labels).mean().item() < math.log(2) + 0.1


def test_true_probabilities_are_calibrated():
    # Of four pairs with a predicted probability of 0.75, three are labelled 1.
    assert calibration_error([0.75] * 4, [1, 1, 1, 0]) == pytest.approx(0)
    assert calibration_error([1.0, 0.0], [1, 0]) == pytest.approx(0)


def test_pairs_count_in_both_orders_and_empty_bins_are_left_out():
    bins = calibration_bins([0.75] * 4, [1, 1, 0.5, 0])
    assert bins == (CalibrationBin(0.25, 0.375, 4), CalibrationBin(0.75, 0.625, 4))
    assert calibration_bins([1.0], [1]) == (CalibrationBin(0.0, 0.0, 1), CalibrationBin(1.0, 1.0, 1))
    assert calibration_bins([], []) == ()


def test_calibration_error_is_the_distance_to_the_observed_frequency():
    assert calibration_error([0.95] * 4, [1, 1, 0, 0]) == pytest.approx(0.45)
    assert math.isnan(calibration_error([], []))


@given(st.lists(st.tuples(st.floats(0, 1), st.sampled_from([0.0, 0.5, 1.0])), min_size=1, max_size=30))
def test_calibration_does_not_depend_on_the_order_of_a_pair(pairs):
    predicted, labels = np.array(pairs).T
    swapped = calibration_error(1 - predicted, 1 - labels)
    # A probability that is an edge of a bin may fall to either side of it when swapped.
    assert (
        swapped == pytest.approx(calibration_error(predicted, labels), abs=1e-9)
        or (np.isclose((predicted * 10) % 1, 0) | np.isclose((predicted * 10) % 1, 1)).any()
    )


def test_correlation_with_a_constant_is_nan():
    assert math.isnan(correlation([1, 1, 1], [1, 2, 3]))


def test_rank_correlation_is_invariant_to_increasing_functions():
    values = np.array([0.1, 3.0, -2.0, 5.0])
    assert rank_correlation(values, np.exp(values)) == pytest.approx(1)
    assert rank_correlation(values, -(values**3)) == pytest.approx(-1)


def test_ties_share_their_mean_rank():
    # Ranks 1.5, 1.5, 3 against 1, 2, 3.
    assert rank_correlation([0, 0, 1], [1, 2, 3]) == pytest.approx(correlation([1.5, 1.5, 3], [1, 2, 3]))


def test_rank_correlation_equals_that_of_scipy():
    first, second = np.random.default_rng(0).integers(0, 20, size=(2, 100))
    assert rank_correlation(first, second) == pytest.approx(spearmanr(first, second).statistic)


def test_rank_correlation_with_nan_is_nan():
    assert math.isnan(rank_correlation([0.5, math.nan, 2.0], [1, 2, 3]))
