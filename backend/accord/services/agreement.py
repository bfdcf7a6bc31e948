"""Statistics of labels with 95% intervals: proportions, medians, and the agreement of labellers."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import sqrt

import krippendorff
import numpy as np

from accord.domain.label_values import SIDES

#: z of a 95% interval
_Z = 1.959964
_RESAMPLES = 500


@dataclass(frozen=True, slots=True)
class Share:
    """A proportion with its interval (Wilson 1927), which stays within 0 and 1 and is wide for few trials."""

    count: int
    of: int
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with the percentile interval of a bootstrap."""

    value: float
    low: float
    high: float
    #: number of samples
    of: int


def share_of(outcomes: Iterable[bool]) -> Share | None:
    """The share that is true; None if there are no outcomes."""
    found = list(outcomes)
    if not found:
        return None
    n, count = len(found), sum(found)
    centre = (count + _Z**2 / 2) / (n + _Z**2)
    half = _Z / (n + _Z**2) * sqrt(count * (n - count) / n + _Z**2 / 4)
    return Share(count, n, max(0.0, centre - half), min(1.0, centre + half))


def median_of(values: Sequence[float]) -> Estimate | None:
    """The median; None if there are no values. The same values give the same interval."""
    if not values:
        return None
    samples = np.asarray(values)
    drawn = np.random.default_rng(0).integers(len(samples), size=(_RESAMPLES, len(samples)))
    low, high = np.quantile(np.median(samples[drawn], axis=1), (0.025, 0.975))
    return Estimate(float(np.median(samples)), float(low), float(high), len(samples))


def alpha_of(labels_of_queries: Iterable[Sequence[float]]) -> Estimate | None:
    """Krippendorff's alpha of the sides 0, 0.5 and 1 as an ordinal scale: 1 is full agreement, 0 that of chance.

    Args:
        labels_of_queries: the sides (`side_of`) that different people prefer on each query; queries with one label
            are left out.

    Returns:
        The estimate with its number of queries; None if there is no query with several labels, or all labels are
        equal, for which chance agreement is not defined.
    """
    counts = np.array(
        [[sum(each == value for each in labels) for value in SIDES] for labels in labels_of_queries if len(labels) > 1]
    )
    if not len(counts) or (counts.sum(axis=0) > 0).sum() < 2:
        return None
    drawn = np.random.default_rng(0).integers(len(counts), size=(_RESAMPLES, len(counts)))
    # A resample whose labels are all equal has no alpha.
    resampled = [_alpha(counts[rows]) for rows in drawn if (counts[rows].sum(axis=0) > 0).sum() > 1]
    low, high = np.quantile(resampled, (0.025, 0.975)) if resampled else (-1.0, 1.0)
    return Estimate(_alpha(counts), float(low), float(high), len(counts))


def _alpha(counts: np.ndarray) -> float:
    return float(krippendorff.alpha(value_counts=counts, value_domain=list(SIDES), level_of_measurement="ordinal"))
