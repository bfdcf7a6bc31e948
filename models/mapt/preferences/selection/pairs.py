"""Pairs of segments by their places, drawn without asking twice."""

from collections.abc import Collection, Sequence

import numpy as np

from mapt.preferences.selection.protocol import IntArray, SegmentId


def places_of(segment_ids: Sequence[SegmentId], pairs: Collection[tuple[SegmentId, SegmentId]]) -> IntArray:
    """Places (P, 2) in `segment_ids` of those pairs whose segments are both there."""
    place = {segment_id: index for index, segment_id in enumerate(segment_ids)}
    found = [(place[first], place[second]) for first, second in pairs if first in place and second in place]
    return np.array(found, dtype=np.int64).reshape(-1, 2)


class FreePairs:
    """The unordered pairs of n segments without those taken; each has one number, smaller place first."""

    def __init__(self, n_segments: int, taken: IntArray) -> None:
        self._n_segments = n_segments
        self._taken = np.unique(self._numbers(taken))

    def __len__(self) -> int:
        return self._n_segments * (self._n_segments - 1) // 2 - len(self._taken)

    def draw(self, k: int, rng: np.random.Generator) -> IntArray:
        """Places (K, 2) of k different free pairs, or of all: each pair alike likely, its order by a fair coin."""
        k = min(k, len(self))
        # While half of all pairs stay free, two draws a pair are enough on average.
        numbers = self._draw_by_rejection(k, rng) if len(self) > len(self._taken) + 2 * k else self._draw_rest(k, rng)
        pairs = np.stack(np.divmod(numbers, max(1, self._n_segments)), axis=1)
        flip = rng.random(k) < 0.5
        pairs[flip] = pairs[flip, ::-1]
        return pairs

    def _draw_by_rejection(self, k: int, rng: np.random.Generator) -> IntArray:
        chosen = np.empty(0, dtype=np.int64)
        while len(chosen) < k:
            first = rng.integers(self._n_segments, size=2 * k)
            second = rng.integers(self._n_segments - 1, size=2 * k)
            second += second >= first
            drawn = self._numbers(np.stack((first, second), axis=1))
            drawn = np.concatenate((chosen, drawn[~np.isin(drawn, self._taken)]))
            # the first time each was drawn, in the order of drawing: keeping the smallest would not be uniform
            chosen = drawn[np.sort(np.unique(drawn, return_index=True)[1])][:k]
        return chosen

    def _draw_rest(self, k: int, rng: np.random.Generator) -> IntArray:
        every = self._numbers(np.stack(np.triu_indices(self._n_segments, 1), axis=1))
        return rng.permutation(np.setdiff1d(every, self._taken, assume_unique=True))[:k]

    def _numbers(self, pairs: IntArray) -> IntArray:
        return pairs.min(axis=1) * self._n_segments + pairs.max(axis=1)
