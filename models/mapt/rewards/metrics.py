"""How good a reward model's preferences and rewards are."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

CALIBRATION_BINS = 10


def accuracy(probabilities: ArrayLike, labels: ArrayLike) -> float:
    """Share of decided pairs (label not 0.5) whose better segment is told rightly; NaN without any.

    Args:
        probabilities: predicted P(segment 0 preferred), (B,).
        labels: (B,).
    """
    predicted, label = _float_arrays(probabilities, labels)
    decided = label != 0.5
    if not decided.any():
        return float("nan")
    return float(((predicted > 0.5) == (label > 0.5))[decided].mean())


def calibration_error(probabilities: ArrayLike, labels: ArrayLike) -> float:
    """Expected calibration error: mean distance of predicted probability and label, over ten equal bins.

    Every pair counts twice, once in each order, since which segment comes first says nothing.
    """
    predicted, label = _float_arrays(probabilities, labels)
    if not len(predicted):
        return float("nan")
    predicted = np.concatenate((predicted, 1 - predicted))
    label = np.concatenate((label, 1 - label))
    bins = np.minimum((predicted * CALIBRATION_BINS).astype(np.int64), CALIBRATION_BINS - 1)
    gap = np.bincount(bins, weights=predicted - label, minlength=CALIBRATION_BINS)
    return float(np.abs(gap).sum() / len(predicted))


def rank_correlation(first: ArrayLike, second: ArrayLike) -> float:
    """Spearman's rank correlation of two (B,) arrays; equal values share their mean rank. NaN if one is constant."""
    ranks = [_mean_ranks(np.asarray(values, dtype=np.float64)) for values in (first, second)]
    return correlation(*ranks)


def correlation(first: ArrayLike, second: ArrayLike) -> float:
    """Pearson's correlation of two (B,) arrays; NaN if one is constant."""
    centred = [values - values.mean() for values in _float_arrays(first, second)]
    scale = np.sqrt((centred[0] ** 2).sum() * (centred[1] ** 2).sum())
    return float((centred[0] * centred[1]).sum() / scale) if scale > 0 else float("nan")


def _mean_ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - (counts - 1) / 2)[inverse]


def _float_arrays(first: ArrayLike, second: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
