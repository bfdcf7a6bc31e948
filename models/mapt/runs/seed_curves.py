"""Curves of several seeds at the same steps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: parts of a curve, in each of which a seed's points are averaged: more cannot be told apart
MOST_BINS = 150


class Curve(Protocol):
    """Returns of the episodes of one run, by the steps at which they ended."""

    @property
    def curve_steps(self) -> NDArray[np.int64]:
        """(P,), in order."""
        ...

    @property
    def curve_returns(self) -> NDArray[np.float64]:
        """(P,)."""
        ...


@dataclass(frozen=True, slots=True)
class SeedCurves:
    """Curves of several seeds at the same steps."""

    #: (B,)
    steps: NDArray[np.float64]
    #: (seeds, B); NaN outside of what a seed has seen
    returns: NDArray[np.float64]

    def whole(self) -> NDArray[np.bool_]:
        """(B,): where every seed has a value; elsewhere a mean would jump where a seed ends."""
        return np.all(np.isfinite(self.returns), axis=0, keepdims=True)[0]


def seed_curves(runs: Sequence[Curve], most_bins: int = MOST_BINS) -> SeedCurves:
    """Means of each run's points by bins of steps; a bin without points lies on the line between its neighbours."""
    points = max(len(run.curve_steps) for run in runs)
    last = max(int(run.curve_steps[-1]) for run in runs if len(run.curve_steps))
    edges = np.linspace(0, last, min(points, most_bins) + 1)
    # Binned alike, steps at the bins' ends and returns belong together for all seeds.
    return SeedCurves(edges[1:], np.stack([_binned(run, edges) for run in runs]))


def deviation(returns: ArrayLike) -> NDArray[np.float64]:
    """Sample standard deviation over the first axis, the seeds; 0 of a single one."""
    values = np.asarray(returns, dtype=np.float64)
    return np.asarray(values.std(axis=0, ddof=min(1, len(values) - 1)))


def _binned(run: Curve, edges: NDArray[np.float64]) -> NDArray[np.float64]:
    values = np.full(len(edges) - 1, np.nan)
    if not len(run.curve_steps):
        return values
    place = np.clip(np.searchsorted(edges, run.curve_steps, side="left") - 1, 0, len(values) - 1)
    counts = np.bincount(place, minlength=len(values))
    sums = np.bincount(place, run.curve_returns, minlength=len(values))
    filled = np.flatnonzero(counts)
    between = np.arange(filled[0], filled[-1] + 1)
    values[between] = np.interp(between, filled, sums[filled] / counts[filled])
    return values
