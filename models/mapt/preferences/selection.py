"""Which pairs of segments to ask about."""

from collections.abc import Collection, Hashable, Sequence
from itertools import combinations
from typing import Protocol, TypeVar

import numpy as np

SegmentId = TypeVar("SegmentId", bound=Hashable)


class QuerySelector(Protocol):
    """Chooses pairs to be labelled next."""

    def select(
        self,
        segment_ids: Sequence[SegmentId],
        paired: Collection[tuple[SegmentId, SegmentId]],
        k: int,
    ) -> list[tuple[SegmentId, SegmentId]]:
        """Choose up to k pairs of different segments.

        Args:
            segment_ids: the segments to choose among, each once.
            paired: pairs asked about before, in either order; none of them is chosen again.
            k: how many pairs are wanted.

        Returns:
            k different pairs, or as many as are left.
        """
        ...


class UniformSelector:
    """Draws every pair not asked about yet with the same probability, and its order by a fair coin."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def select(
        self,
        segment_ids: Sequence[SegmentId],
        paired: Collection[tuple[SegmentId, SegmentId]],
        k: int,
    ) -> list[tuple[SegmentId, SegmentId]]:
        """See `QuerySelector.select`."""
        taken = {frozenset(pair) for pair in paired}
        n_segments = len(segment_ids)
        n_pairs = n_segments * (n_segments - 1) // 2
        if 2 * (len(taken) + k) > n_pairs:
            return self._select_from_rest(segment_ids, taken, k)
        return self._select_by_rejection(segment_ids, taken, k)

    def _select_by_rejection(
        self, segment_ids: Sequence[SegmentId], taken: set[frozenset[SegmentId]], k: int
    ) -> list[tuple[SegmentId, SegmentId]]:
        # At least half of all pairs are free here, so two draws a pair are enough on average.
        chosen: list[tuple[SegmentId, SegmentId]] = []
        n_segments = len(segment_ids)
        while len(chosen) < k:
            first = int(self._rng.integers(n_segments))
            second = int(self._rng.integers(n_segments - 1))
            second += second >= first
            pair = (segment_ids[first], segment_ids[second])
            if frozenset(pair) not in taken:
                taken.add(frozenset(pair))
                chosen.append(pair)
        return chosen

    def _select_from_rest(
        self, segment_ids: Sequence[SegmentId], taken: set[frozenset[SegmentId]], k: int
    ) -> list[tuple[SegmentId, SegmentId]]:
        rest = [pair for pair in combinations(segment_ids, 2) if frozenset(pair) not in taken]
        order = self._rng.permutation(len(rest))[:k]
        swap = self._rng.random(len(order)) < 0.5
        return [rest[i][::-1] if flip else rest[i] for i, flip in zip(order, swap, strict=True)]
