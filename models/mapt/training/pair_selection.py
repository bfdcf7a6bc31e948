"""Choose the next pairs to label. Needs numpy only."""

from collections.abc import Callable, Collection, Hashable, Sequence
from typing import Generic, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.selection import (
    ChosenPair,
    ControlledSelector,
    RecentSelector,
    SegmentView,
    SelectorName,
    UniformSelector,
    make_selector,
    needs_view,
    segment_features,
)
from mapt.preferences.selection.protocol import SegmentId

#: `recent` chooses from this many of the newest segments
RECENT_CANDIDATES = 2000
#: selectors that need a view choose from this many, which are read once and scored for every reward version
SCORED_SEGMENTS = 512
#: number of the newest queries whose pairs are the initial centers of k-center
PAIRED_FEATURES = 1000
#: segments read at once
_CHUNK = 64

Key = TypeVar("Key", bound=Hashable)
_Vector = NDArray[np.float32]


def choose_pairs(
    segment_ids: Sequence[SegmentId],
    paired: Collection[frozenset[SegmentId]],
    k: int,
    *,
    selector: SelectorName,
    control_share: float,
    view: SegmentView | None,
    first_round: bool,
    rng: np.random.Generator,
) -> list[ChosenPair[SegmentId]]:
    """Choose up to k pairs that have no query yet, each with the name of its selector.

    Selectors that need a view draw their candidate pairs with an emphasis on recent segments; their control pairs are
    uniform over all pairs without a query.

    Args:
        segment_ids: the candidates, from new to old; see `candidate_limit`.
        paired: pairs that have a query, in either order.
        selector: chooses the pairs after the first round, which is uniform.
        control_share: share of the pairs that stays uniform, as a control, if the selector needs a view.
        view: scores and features of the first `view.n_segments` candidates, from which a selector that needs a view
            chooses. None draws all its pairs uniformly, for example while its ensemble is missing.
        first_round: whether there is no reward version yet.

    Raises:
        UnknownSelector: if no selector has this name.
    """
    known = [cast("tuple[SegmentId, SegmentId]", tuple(pair)) for pair in paired]
    uniform = UniformSelector(rng)
    informed = make_selector(selector, rng, propose=RecentSelector(rng))
    if needs_view(selector) and not first_round:
        return ControlledSelector(informed, uniform, control_share, rng).choose(segment_ids, known, k, view)
    chooser = uniform if first_round else informed
    return [ChosenPair(pair, chooser.name) for pair in chooser.select(segment_ids, known, k)]


def candidate_limit(selector: SelectorName) -> int | None:
    """Number of the newest segments from which pairs are chosen; None for all segments."""
    return RECENT_CANDIDATES if selector == "recent" else None


class SegmentScorer(Generic[Key]):
    """Computes scores and features of segments for selectors, once for each segment.

    Args:
        read: returns the arrays of segments.
    """

    def __init__(self, read: Callable[[Sequence[Key]], SegmentArrays]) -> None:
        self._read = read
        #: (F,) of each segment
        self._features: dict[Key, _Vector] = {}
        #: (M,) of each segment, by the ensemble of one reward version
        self._scores: dict[Key, _Vector] = {}
        self._version = ""

    def view(
        self,
        segments: Sequence[Key],
        version: str,
        score: Callable[[SegmentArrays], NDArray[np.float32]] | None,
        pairs: Sequence[tuple[Key, Key]] | None,
    ) -> SegmentView:
        """Scores and features of S segments.

        Args:
            version: the reward version of `score`.
            score: the scores (M, S) of segments by each member of an ensemble; None if the selector needs none.
            pairs: pairs that already have a query; None if the selector needs no features.
        """
        scores = None if score is None else self.scores(segments, version, score)
        if pairs is None:
            return SegmentView(scores)
        features = self.features(segments)
        keys = [key for pair in pairs for key in pair]
        return SegmentView(scores, features, self.features(keys).reshape(-1, 2, features.shape[1]) if keys else None)

    def scores(
        self, segments: Sequence[Key], version: str, score: Callable[[SegmentArrays], NDArray[np.float32]]
    ) -> NDArray[np.float32]:
        """Score of each segment by each member of the version's ensemble, (M, S)."""
        if version != self._version:
            self._version, self._scores = version, {}
        for chunk in _new(segments, self._scores):
            self._scores.update(zip(chunk, score(self._read(chunk)).T, strict=True))
        return np.stack([self._scores[key] for key in segments], axis=1)

    def features(self, segments: Sequence[Key]) -> NDArray[np.float32]:
        """`segment_features` of each segment, (S, F)."""
        for chunk in _new(segments, self._features):
            self._features.update(zip(chunk, segment_features(self._read(chunk)), strict=True))
        return np.stack([self._features[key] for key in segments])


def newest_pairs(paired: Collection[frozenset[SegmentId]]) -> list[tuple[SegmentId, SegmentId]]:
    """The `PAIRED_FEATURES` newest pairs that have a query; ids must sort by time."""
    ordered = [cast("tuple[SegmentId, SegmentId]", tuple(sorted(pair))) for pair in paired]  # pyright: ignore[reportArgumentType]
    return sorted(ordered, key=lambda pair: (pair[1], pair[0]))[-PAIRED_FEATURES:]  # pyright: ignore[reportArgumentType, reportCallIssue]


def _new(keys: Sequence[Key], known: dict[Key, _Vector]) -> list[list[Key]]:
    new = [key for key in dict.fromkeys(keys) if key not in known]
    return [new[start : start + _CHUNK] for start in range(0, len(new), _CHUNK)]
