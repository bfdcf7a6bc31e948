"""Significance tests of the difference between two models, over seeds and over test pairs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Normal quantile of a 95% interval.
_NORMAL_QUANTILE = 1.959964


@dataclass(frozen=True, slots=True)
class PairedTest:
    """Student's paired t-test."""

    #: number of differences
    n: int
    mean: float
    #: sample standard deviation; NaN with fewer than two
    deviation: float
    #: two-sided; NaN with fewer than two differences
    p: float


def paired_test(differences: ArrayLike) -> PairedTest:
    """Test whether the mean of `differences` (n,) is 0."""
    values = np.asarray(differences, dtype=np.float64)
    n, mean = len(values), float(values.mean()) if len(values) else math.nan
    if n < 2:
        return PairedTest(n, mean, math.nan, math.nan)
    deviation = float(values.std(ddof=1))
    if deviation == 0:
        return PairedTest(n, mean, 0.0, 1.0 if mean == 0 else 0.0)
    return PairedTest(n, mean, deviation, student_p(mean / (deviation / math.sqrt(n)), n - 1))


def student_p(t: float, degrees: int) -> float:
    """Two-sided p of Student's t with a whole number of degrees of freedom.

    Uses the finite series for whole degrees (Abramowitz and Stegun, 26.7.3 and 26.7.4).
    """
    angle = math.atan2(abs(t), math.sqrt(degrees))
    cosine_squared = math.cos(angle) ** 2
    odd = degrees % 2
    term = math.cos(angle) if odd else 1.0
    total = 0.0
    for k in range(odd, degrees - 1, 2):
        total += term
        term *= cosine_squared * (k + 1) / (k + 2)
    within = math.sin(angle) * total
    return max(0.0, 1 - (2 / math.pi * (angle + within) if odd else within))


@dataclass(frozen=True, slots=True)
class McNemar:
    """McNemar's test: counts of pairs that only one of two models predicts correctly."""

    #: correct only by the model; correct only by the baseline
    gained: int
    lost: int
    #: two-sided, exact
    p: float


def mcnemar(right: ArrayLike, baseline_right: ArrayLike) -> McNemar:
    """McNemar's exact test on pairs (P,) that a model and a baseline predict correctly or not."""
    own, other = np.asarray(right, dtype=np.bool_), np.asarray(baseline_right, dtype=np.bool_)
    gained, lost = int((own & ~other).sum()), int((other & ~own).sum())
    return McNemar(gained, lost, binomial_p(min(gained, lost), gained + lost))


def binomial_p(k: int, n: int) -> float:
    """Two-sided p of the binomial test with probability 1/2: at most k of n, k <= n / 2."""
    if n == 0:
        return 1.0
    # In logarithms: n may be thousands.
    logs = [math.lgamma(n + 1) - math.lgamma(i + 1) - math.lgamma(n - i + 1) - n * math.log(2) for i in range(k + 1)]
    return min(1.0, 2 * math.fsum(math.exp(value) for value in logs))


@dataclass(frozen=True, slots=True)
class PairDifferences:
    """Differences between a model and a baseline on the test pairs of one seed."""

    #: (P,): 1 where only the model is correct, -1 where only the baseline is, else 0
    difference: NDArray[np.float64]
    #: segments, int64 (P, 2)
    pairs: NDArray[np.int64]


def difference_interval(tested: Sequence[PairDifferences]) -> tuple[float, float]:
    """95% confidence interval of the mean difference, averaged over seeds, over the draw of test segments.

    Pairs that share a segment are correlated: the standard error includes the covariance of all pairs with a common
    segment (dyadic clusters; Aronow, Samii and Assenova, 2015).
    """
    mean = float(np.mean([one.difference.mean() for one in tested]))
    error = math.sqrt(sum(_variance_of_mean(one) for one in tested)) / len(tested)
    return mean - _NORMAL_QUANTILE * error, mean + _NORMAL_QUANTILE * error


def _variance_of_mean(tested: PairDifferences) -> float:
    """Variance of the mean difference: residual products summed over pairs that share a segment."""
    residual = tested.difference - tested.difference.mean()
    _, place = np.unique(tested.pairs, return_inverse=True)
    by_segment = np.bincount(place.ravel(), residual.repeat(2))
    independent = float((residual**2).sum())
    # Each pair is counted with itself at both of its segments. With few pairs the estimate can be too small.
    return max(float((by_segment**2).sum()) - independent, independent) / len(residual) ** 2
