"""The seam behind which every way to choose queries stands."""

from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapt.errors import NotFinite, ShapeError

#: B-Pref's samplers (Lee et al. 2021); *_k_center narrows by uncertainty first, then spreads out
SelectorName = Literal["uniform", "disagreement", "entropy", "k_center", "disagreement_k_center", "entropy_k_center"]
SegmentId = TypeVar("SegmentId", bound=Hashable)
FloatArray = NDArray[np.floating]
#: places in a list of segments
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class SegmentView:
    """What is known of S segments; row i tells of the i-th one offered.

    Raises:
        ShapeError, NotFinite: naming the array that cannot be used.
    """

    #: (M, S), each ensemble member's score of each segment: P(a preferred to b) = sigmoid(score_a - score_b)
    scores: FloatArray | None = None
    #: (S, F), in which segments that are alike lie close together
    features: FloatArray | None = None
    #: (P, 2, F), features of pairs asked about before, which k-center keeps away from;
    #: None takes those among the offered segments
    asked: FloatArray | None = None

    def __post_init__(self) -> None:
        for name, array, n_axes in (
            ("scores", self.scores, 2),
            ("features", self.features, 2),
            ("asked", self.asked, 3),
        ):
            if array is None:
                continue
            if array.ndim != n_axes:
                raise ShapeError(name, array.shape, f"{n_axes} axes")
            if not np.isfinite(array).all():
                broken = int(np.argwhere(~np.isfinite(array))[0][1 if name == "scores" else 0])
                raise NotFinite(name, broken)
        if self.asked is not None:
            n_features = None if self.features is None else self.features.shape[1]
            if self.asked.shape[1:] != (2, n_features):
                raise ShapeError("asked", self.asked.shape, f"(P, 2, {n_features})")

    @property
    def n_segments(self) -> int:
        """S; 0 of a view that tells of nothing."""
        if self.scores is not None:
            return self.scores.shape[1]
        return 0 if self.features is None else len(self.features)

    def check(self, n_segments: int) -> None:
        """Raises ShapeError unless every row tells of one of `n_segments` segments."""
        if self.scores is not None and self.scores.shape[1] != n_segments:
            raise ShapeError("scores", self.scores.shape, f"(M, {n_segments})")
        if self.features is not None and len(self.features) != n_segments:
            raise ShapeError("features", self.features.shape, f"({n_segments}, F)")


class QuerySelector(Protocol):
    """Chooses pairs to be labelled next."""

    @property
    def name(self) -> SelectorName:
        """What the choice is recorded under."""
        ...

    def select(
        self,
        segment_ids: Sequence[SegmentId],
        paired: Collection[tuple[SegmentId, SegmentId]],
        k: int,
        view: SegmentView | None = None,
    ) -> list[tuple[SegmentId, SegmentId]]:
        """Choose up to k pairs of different segments; which of the two comes first is left to a fair coin.

        Args:
            segment_ids: the segments to choose among, each once.
            paired: pairs asked about before, in either order; none of them is chosen again.
            k: how many pairs are wanted.
            view: what is known of the segments, row by row as in `segment_ids`.

        Returns:
            k different pairs, or as many as are left.

        Raises:
            MissingView: if the selector chooses by what `view` does not hold.
            ShapeError: if `view` tells of another number of segments.
        """
        ...


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
