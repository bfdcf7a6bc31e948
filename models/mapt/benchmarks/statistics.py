"""Significance tests of the difference between two models, and interquartile means over seeds."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

#: Normal quantile of a 95% interval.
_NORMAL_QUANTILE = float(stats.norm.ppf(0.975))
_RESAMPLES = 2000
#: fraction of the values that an interquartile mean leaves out at each end
_TRIMMED = 0.25


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
    test: Any = stats.ttest_1samp(values, 0.0)
    return PairedTest(n, mean, deviation, float(test.pvalue))


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
    return McNemar(gained, lost, float(stats.binomtest(gained, gained + lost).pvalue) if gained + lost else 1.0)


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


@dataclass(frozen=True, slots=True)
class InterquartileMean:
    """The mean of the middle half of the values, with a 95% bootstrap interval."""

    value: float
    #: NaN if a sample has fewer than two values
    low: float
    high: float


def interquartile_mean_with_interval(samples: Sequence[ArrayLike]) -> InterquartileMean:
    """Interquartile mean over all values of several samples, such as the seeds of several tasks.

    The interval is of the stratified percentile bootstrap, which resamples within each sample (Agarwal et al. 2021).
    It is that of `rliable.library.get_interval_estimates`, up to random draws; rliable needs arch, statsmodels, pandas
    and seaborn. As there, fewer than four values are not trimmed.
    """
    values = [np.asarray(sample, dtype=np.float64) for sample in samples]

    def trimmed_mean(*resampled: NDArray[np.float64], axis: int) -> Any:
        return stats.trim_mean(np.concatenate(resampled, axis=axis), _TRIMMED, axis=axis)

    mean = float(trimmed_mean(*values, axis=0))
    if min(map(len, values)) < 2:
        return InterquartileMean(mean, math.nan, math.nan)
    found: Any = stats.bootstrap(
        values, trimmed_mean, n_resamples=_RESAMPLES, method="percentile", rng=np.random.default_rng(0)
    )
    return InterquartileMean(mean, float(found.confidence_interval.low), float(found.confidence_interval.high))
