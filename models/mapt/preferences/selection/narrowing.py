"""Selectors that draw many candidates and narrow them down by what is known of the segments."""

from collections.abc import Callable, Collection, Sequence

import numpy as np

from mapt.errors import MissingView
from mapt.preferences.selection.coverage import k_center, scaled
from mapt.preferences.selection.pairs import places_of
from mapt.preferences.selection.protocol import (
    FloatArray,
    IntArray,
    QuerySelector,
    SegmentId,
    SegmentView,
    SelectorName,
)

#: candidates drawn for each query wanted (B-Pref's large_batch)
CANDIDATES_PER_QUERY = 10
#: the share of the candidates that a stage leaves to the next one (B-Pref)
KEPT_SHARE = 0.5

#: (view, candidate pairs (K, 2), asked pairs (P, 2), k) -> places in the candidates of the k best, best first
Stage = Callable[[SegmentView, IntArray, IntArray, int], IntArray]


class NarrowingSelector:
    """Candidates from another selector, narrowed by one stage after the other."""

    def __init__(self, name: SelectorName, propose: QuerySelector, stages: Sequence[Stage]) -> None:
        """
        Args:
            propose: draws the candidates.
            stages: each but the last keeps half of what it gets, the last as many as are wanted.
        """
        self._name: SelectorName = name
        self._propose = propose
        self._stages = stages

    @property
    def name(self) -> SelectorName:
        return self._name

    def select(
        self,
        segment_ids: Sequence[SegmentId],
        paired: Collection[tuple[SegmentId, SegmentId]],
        k: int,
        view: SegmentView | None = None,
    ) -> list[tuple[SegmentId, SegmentId]]:
        """See `QuerySelector.select`."""
        view = view or SegmentView()
        view.check(len(segment_ids))
        candidates = self._propose.select(segment_ids, paired, CANDIDATES_PER_QUERY * k)
        if not candidates:
            return []
        pairs, asked = places_of(segment_ids, candidates), places_of(segment_ids, paired)
        left = np.arange(len(pairs))
        for turn, stage in enumerate(self._stages, start=1):
            kept = k if turn == len(self._stages) else max(k, round(len(left) * KEPT_SHARE))
            left = left[stage(view, pairs[left], asked, kept)]
        return [candidates[place] for place in left.tolist()]


def most_uncertain(measure: Callable[[FloatArray, IntArray], FloatArray]) -> Stage:
    """Keeps the pairs of which the ensemble is least sure, by a measure of `uncertainty`."""

    def keep(view: SegmentView, pairs: IntArray, asked: IntArray, k: int) -> IntArray:
        if view.scores is None:
            raise MissingView("an ensemble's scores")
        # stable: among equals, the candidate that was drawn first
        return np.argsort(-measure(view.scores, pairs), kind="stable")[:k]

    return keep


def farthest(view: SegmentView, pairs: IntArray, asked: IntArray, k: int) -> IntArray:
    """Keeps the pairs that cover the segments best: see `coverage.k_center`."""
    if view.features is None:
        raise MissingView("features")
    asked_features = view.features[asked] if view.asked is None else view.asked
    features, asked_features = scaled(view.features, asked_features)
    return k_center(features[pairs], asked_features, k)
