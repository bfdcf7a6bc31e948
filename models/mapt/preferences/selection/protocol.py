"""The interface of query selectors, and uniform sampling of pairs without repetition."""

from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapt.errors import NotFinite, ShapeError

#: B-Pref's samplers (Lee et al. 2021), and `recent`. *_k_center keeps the most uncertain pairs, then applies k-center
SelectorName = Literal[
    "uniform", "recent", "disagreement", "entropy", "k_center", "disagreement_k_center", "entropy_k_center"
]
SegmentId = TypeVar("SegmentId", bound=Hashable)
FloatArray = NDArray[np.floating]
#: indices into a list of segments
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class SegmentView:
    """Scores and features of S candidate segments, by which a selector chooses.

    Raises:
        ShapeError, NotFinite: for an array with the wrong shape, or with NaN or infinity.
    """

    #: (M, S), score of each segment by each ensemble member: P(a preferred to b) = sigmoid(score_a - score_b)
    scores: FloatArray | None = None
    #: (S, F), embedding of each segment for k-center
    features: FloatArray | None = None
    #: (P, 2, F), embeddings of the pairs labelled or queried so far, the initial centers of k-center;
    #: None for the pairs in `paired`
    queried: FloatArray | None = None

    def __post_init__(self) -> None:
        for name, array, n_axes in (
            ("scores", self.scores, 2),
            ("features", self.features, 2),
            ("queried", self.queried, 3),
        ):
            if array is None:
                continue
            if array.ndim != n_axes:
                raise ShapeError(name, array.shape, f"{n_axes} axes")
            if not np.isfinite(array).all():
                index = int(np.argwhere(~np.isfinite(array))[0][1 if name == "scores" else 0])
                raise NotFinite(name, index)
        if self.queried is not None:
            n_features = None if self.features is None else self.features.shape[1]
            if self.queried.shape[1:] != (2, n_features):
                raise ShapeError("queried", self.queried.shape, f"(P, 2, {n_features})")

    @property
    def n_segments(self) -> int:
        """S, or 0 if the view holds no array."""
        if self.scores is not None:
            return self.scores.shape[1]
        return 0 if self.features is None else len(self.features)

    def check(self, n_segments: int) -> None:
        """Raise ShapeError unless S is `n_segments`."""
        if self.scores is not None and self.scores.shape[1] != n_segments:
            raise ShapeError("scores", self.scores.shape, f"(M, {n_segments})")
        if self.features is not None and len(self.features) != n_segments:
            raise ShapeError("features", self.features.shape, f"({n_segments}, F)")


class QuerySelector(Protocol):
    """Chooses the pairs of segments to label next."""

    @property
    def name(self) -> SelectorName:
        """Recorded with each query."""
        ...

    def select(
        self,
        segment_ids: Sequence[SegmentId],
        paired: Collection[tuple[SegmentId, SegmentId]],
        k: int,
        view: SegmentView | None = None,
    ) -> list[tuple[SegmentId, SegmentId]]:
        """Choose up to k pairs of different segments, each in random order.

        Args:
            segment_ids: the candidates, from new to old, without repetition.
            paired: earlier queries, each in either order; they are not chosen again.
            k: number of pairs.
            view: scores and features of the candidates, in the order of `segment_ids`.

        Returns:
            k different pairs, or all that are left.

        Raises:
            MissingArray: if `view` lacks an array that the selector needs.
            ShapeError: if `view` holds another number of segments.
        """
        ...


def indices_of(segment_ids: Sequence[SegmentId], pairs: Collection[tuple[SegmentId, SegmentId]]) -> IntArray:
    """Indices (P, 2) into `segment_ids` of the pairs whose two segments are both in it."""
    index = {segment_id: position for position, segment_id in enumerate(segment_ids)}
    found = [(index[first], index[second]) for first, second in pairs if first in index and second in index]
    return np.array(found, dtype=np.int64).reshape(-1, 2)


class UnqueriedPairs:
    """The unordered pairs of n segments that were not queried. A pair (i, j) with i < j has the key i * n + j."""

    def __init__(self, n_segments: int, queried: IntArray) -> None:
        self._n_segments = n_segments
        self._queried = np.unique(self._keys(queried))

    def __len__(self) -> int:
        return self._n_segments * (self._n_segments - 1) // 2 - len(self._queried)

    def draw(self, k: int, rng: np.random.Generator) -> IntArray:
        """Draw min(k, len(self)) different pairs uniformly, each in random order: indices (K, 2)."""
        k = min(k, len(self))
        # Rejection needs two draws per pair on average while at least half of all pairs are left.
        by_rejection = len(self) > len(self._queried) + 2 * k
        keys = self._draw_by_rejection(k, rng) if by_rejection else self._draw_from_all(k, rng)
        pairs = np.stack(np.divmod(keys, max(1, self._n_segments)), axis=1)
        flip = rng.random(k) < 0.5
        pairs[flip] = pairs[flip, ::-1]
        return pairs

    def _draw_by_rejection(self, k: int, rng: np.random.Generator) -> IntArray:
        chosen = np.empty(0, dtype=np.int64)
        while len(chosen) < k:
            first = rng.integers(self._n_segments, size=2 * k)
            second = rng.integers(self._n_segments - 1, size=2 * k)
            second += second >= first
            drawn = self._keys(np.stack((first, second), axis=1))
            drawn = np.concatenate((chosen, drawn[~np.isin(drawn, self._queried)]))
            # Remove repetitions in the order of drawing: np.unique alone would keep the smallest keys.
            chosen = drawn[np.sort(np.unique(drawn, return_index=True)[1])][:k]
        return chosen

    def _draw_from_all(self, k: int, rng: np.random.Generator) -> IntArray:
        every = self._keys(np.stack(np.triu_indices(self._n_segments, 1), axis=1))
        return rng.permutation(np.setdiff1d(every, self._queried, assume_unique=True))[:k]

    def _keys(self, pairs: IntArray) -> IntArray:
        return pairs.min(axis=1) * self._n_segments + pairs.max(axis=1)
