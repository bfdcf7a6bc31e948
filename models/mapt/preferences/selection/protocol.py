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
