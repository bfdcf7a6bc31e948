"""Choose the next pairs to label, with an emphasis on recent segments. Needs numpy only."""

from collections.abc import Callable, Collection, Hashable, Sequence
from typing import Generic, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.selection import (
    ChosenPair,
    ControlledSelector,
    SegmentView,
    SelectorName,
    UniformSelector,
    make_selector,
    segment_features,
)
from mapt.preferences.selection.protocol import SegmentId

#: pairs are chosen from this many of the newest segments
CANDIDATES = 2000
#: selectors other than uniform choose from this many, which are read once and scored for every reward version
SCORED_SEGMENTS = 512
#: number of the newest queries whose pairs are the initial centers of k-center
PAIRED_FEATURES = 1000
#: segments read at once
_CHUNK = 64

#: share of the segments that counts as recent, and the minimum number
RECENT_SHARE = 0.25
FEWEST_RECENT = 16
#: draws per pair before `RecentPairs` gives up on pairs with a recent segment
_DRAWS_PER_PAIR = 20

Key = TypeVar("Key", bound=Hashable)
_Vector = NDArray[np.float32]


class RecentPairs:
    """Draws pairs with recent segments: half compare two recent ones, half a recent one with any segment.

    Labels on the policy's current behaviour matter most; pairs with older segments keep the scale of the reward.
    """

    name: SelectorName = "uniform"

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._uniform = UniformSelector(rng)

    def select(
        self,
        segment_ids: Sequence[SegmentId],
        paired: Collection[tuple[SegmentId, SegmentId]],
        k: int,
        view: SegmentView | None = None,
    ) -> list[tuple[SegmentId, SegmentId]]:
        """See `mapt.preferences.selection.QuerySelector.select`; `segment_ids` are sorted from new to old."""
        recent = segment_ids[: max(FEWEST_RECENT, round(len(segment_ids) * RECENT_SHARE))]
        chosen = self._uniform.select(recent, paired, k // 2)
        taken = {frozenset(pair) for pair in [*paired, *chosen]}
        chosen += self._recent_with_any(recent, segment_ids, taken, k - len(chosen))
        # With few segments there may be fewer such pairs than requested.
        rest = k - len(chosen)
        return chosen + self._uniform.select(segment_ids, [*paired, *chosen], rest) if rest else chosen

    def _recent_with_any(
        self, recent: Sequence[SegmentId], all_ids: Sequence[SegmentId], taken: set[frozenset[SegmentId]], k: int
    ) -> list[tuple[SegmentId, SegmentId]]:
        chosen: list[tuple[SegmentId, SegmentId]] = []
        for _ in range(_DRAWS_PER_PAIR * k):
            if len(chosen) == k:
                break
            new, other = recent[int(self._rng.integers(len(recent)))], all_ids[int(self._rng.integers(len(all_ids)))]
            if new == other or frozenset((new, other)) in taken:
                continue
            taken.add(frozenset((new, other)))
            chosen.append((new, other) if self._rng.integers(2) else (other, new))
        return chosen


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

    Args:
        segment_ids: the candidates, from new to old.
        paired: pairs that have a query, in either order.
        selector: chooses all pairs but the control pairs, once there is a view.
        control_share: share of the pairs that stays uniform, as a control.
        view: scores and features of the first `view.n_segments` candidates, from which the selector chooses. None draws
            all pairs uniformly: before the first reward version, or while an ensemble is missing that the selector
            needs.
        first_round: draw from all segments uniformly; later rounds prefer recent ones.

    Raises:
        UnknownSelector: if no selector has this name.
    """
    known = [cast("tuple[SegmentId, SegmentId]", tuple(pair)) for pair in paired]
    control = UniformSelector(rng) if first_round else RecentPairs(rng)
    informed = make_selector(selector, rng, propose=control)
    chosen: list[ChosenPair[SegmentId]] = []
    if view is not None:
        controlled = ControlledSelector(informed, control, control_share, rng)
        chosen = controlled.choose(segment_ids[: view.n_segments], known, k, view)
    rest = control.select(segment_ids, [*known, *(each.pair for each in chosen)], k - len(chosen))
    return chosen + [ChosenPair(pair, control.name) for pair in rest]


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
