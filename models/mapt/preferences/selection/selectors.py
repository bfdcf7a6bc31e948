"""Query selectors by name, and a mix of a selector with uniform control pairs."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from math import floor
from typing import Generic

import numpy as np

from mapt.errors import InvalidConfig, MissingArray, UnknownSelector
from mapt.preferences.selection.criteria import disagreement, entropy, k_center, standardized
from mapt.preferences.selection.protocol import (
    FloatArray,
    IntArray,
    QuerySelector,
    SegmentId,
    SegmentView,
    SelectorName,
    UnqueriedPairs,
    indices_of,
)


class UniformSelector:
    """Draws pairs uniformly from all pairs of candidates that were not queried before."""

    name: SelectorName = "uniform"

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def select(
        self,
        segment_ids: Sequence[SegmentId],
        paired: Collection[tuple[SegmentId, SegmentId]],
        k: int,
        view: SegmentView | None = None,
    ) -> list[tuple[SegmentId, SegmentId]]:
        """See `QuerySelector.select`."""
        pairs = UnqueriedPairs(len(segment_ids), indices_of(segment_ids, paired))
        return [(segment_ids[first], segment_ids[second]) for first, second in pairs.draw(k, self._rng).tolist()]


#: Fraction of the candidates, the newest, that count as recent, and their minimum number.
RECENT_FRACTION = 0.25
FEWEST_RECENT = 16
#: Draws per pair before `RecentSelector` gives up on pairs with a recent segment.
_DRAWS_PER_PAIR = 20


class RecentSelector:
    """Draws pairs with recent segments: half compare two recent ones, half a recent one with any candidate.

    Labels on the current policy's behaviour matter most to its next updates (near on-policy queries; Hu et al. 2024,
    arXiv 2305.17400); pairs with older segments keep the scale of the reward. Two older segments are compared only when
    every pair with a recent one has a query.

    Segments without a query come first. A segment that is in several pairs teaches less than as many segments do, and
    where pairs share segments, those that share one with the hold-out are lost to the training: with 500 labels in the
    service, they were four in ten.
    """

    name: SelectorName = "recent"

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
        """See `QuerySelector.select`."""
        if not segment_ids:
            return []
        recent = segment_ids[: max(FEWEST_RECENT, round(len(segment_ids) * RECENT_FRACTION))]
        chosen = self._without_query(recent, segment_ids, {id for pair in paired for id in pair}, k)
        n_recent = k // 2 - len(chosen)
        if n_recent > 0:
            chosen += self._uniform.select(recent, [*paired, *chosen], n_recent)
        taken = {frozenset(pair) for pair in [*paired, *chosen]}
        chosen += self._recent_with_any(recent, segment_ids, taken, k - len(chosen))
        # With few segments there may be fewer such pairs than requested.
        rest = k - len(chosen)
        return chosen + self._uniform.select(segment_ids, [*paired, *chosen], rest) if rest else chosen

    def _without_query(
        self, recent: Sequence[SegmentId], all_ids: Sequence[SegmentId], queried: set[SegmentId], k: int
    ) -> list[tuple[SegmentId, SegmentId]]:
        """Up to k pairs of segments that are in no query, each in one pair at most: first those of two recent ones."""
        new = self._shuffled([id for id in recent if id not in queried])
        n_recent = min(k // 2, len(new) // 2)
        chosen = list(zip(new[:n_recent], new[n_recent : 2 * n_recent], strict=True))
        new, used = new[2 * n_recent :], set(new[: 2 * n_recent])
        others = self._shuffled([id for id in all_ids if id not in queried and id not in used])
        while new and len(chosen) < k:
            first = new.pop()
            others.remove(first)
            if not others:
                break
            second = others.pop()
            if second in new:
                new.remove(second)
            chosen.append((first, second) if self._rng.integers(2) else (second, first))
        return chosen

    def _shuffled(self, ids: list[SegmentId]) -> list[SegmentId]:
        return [ids[index] for index in self._rng.permutation(len(ids)).tolist()]

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


#: Candidate pairs drawn per query (B-Pref's large_batch).
CANDIDATES_PER_QUERY = 10
#: Fraction of the candidates that the first of two stages keeps (B-Pref).
KEPT_FRACTION = 0.5

#: (view, candidate pairs (K, 2), queried pairs (P, 2), k) -> indices of the k best candidates, best first
Stage = Callable[[SegmentView, IntArray, IntArray, int], IntArray]


class CandidateSelector:
    """Draws many candidate pairs and keeps the best by one or more criteria."""

    def __init__(self, name: SelectorName, propose: QuerySelector, stages: Sequence[Stage]) -> None:
        """Make a selector.

        Args:
            propose: draws the candidates.
            stages: applied in turn. Each but the last keeps `KEPT_FRACTION` of its candidates, the last keeps k.
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
        pairs, queried = indices_of(segment_ids, candidates), indices_of(segment_ids, paired)
        kept = np.arange(len(pairs))
        for turn, stage in enumerate(self._stages, start=1):
            n_kept = k if turn == len(self._stages) else max(k, round(len(kept) * KEPT_FRACTION))
            kept = kept[stage(view, pairs[kept], queried, n_kept)]
        return [candidates[index] for index in kept.tolist()]


def most_uncertain(criterion: Callable[[FloatArray, IntArray], FloatArray]) -> Stage:
    """The stage that keeps the pairs with the highest `disagreement` or `entropy`."""

    def keep(view: SegmentView, pairs: IntArray, queried: IntArray, k: int) -> IntArray:
        if view.scores is None:
            raise MissingArray("scores")
        # Stable: among equal candidates, the one drawn first.
        return np.argsort(-criterion(view.scores, pairs), kind="stable")[:k]

    return keep


def farthest(view: SegmentView, pairs: IntArray, queried: IntArray, k: int) -> IntArray:
    """The stage that keeps the pairs chosen by `k_center`."""
    if view.features is None:
        raise MissingArray("features")
    centers = view.features[queried] if view.queried is None else view.queried
    features, centers = standardized(view.features, centers)
    return k_center(features[pairs], centers, k)


@dataclass(frozen=True, slots=True)
class ChosenPair(Generic[SegmentId]):
    """A pair, and the name of the selector that chose it."""

    pair: tuple[SegmentId, SegmentId]
    selector: SelectorName


def control_count(k: int, share: float, rng: np.random.Generator) -> int:
    """Number of control pairs among k: k * share, rounded up or down at random so that its mean is exact.

    Raises:
        InvalidConfig: if the share is not in [0, 1].
    """
    if not 0.0 <= share <= 1.0:
        raise InvalidConfig(f"share is {share}; it must lie in [0, 1].", "share")
    return min(k, floor(k * share + rng.random()))


class ControlledSelector:
    """Chooses a share of every batch by a control selector, usually uniform, and the rest by an informed one.

    Uncertainty sampling can do worse than uniform sampling, since it prefers pairs whose labels are noise. Uniform
    pairs reveal this, and are an unbiased test set for the reward model.
    """

    def __init__(
        self, informed: QuerySelector, control: QuerySelector, control_share: float, rng: np.random.Generator
    ) -> None:
        """Make a selector.

        Args:
            informed: chooses among the candidates of the `SegmentView`.
            control: chooses among all candidates. While there is no view, as in the first round, it chooses all pairs,
                and with a view those for which `informed` finds none.
            control_share: fraction of each batch that `control` chooses, in [0, 1].
        """
        self._informed = informed
        self._control = control
        self._share = control_share
        self._rng = rng

    def choose(
        self,
        segment_ids: Sequence[SegmentId],
        paired: Collection[tuple[SegmentId, SegmentId]],
        k: int,
        view: SegmentView | None = None,
    ) -> list[ChosenPair[SegmentId]]:
        """Choose up to k pairs; see `QuerySelector.select` for the arguments and further errors.

        Args:
            view: of the first `view.n_segments` candidates.

        Returns:
            The control pairs, then the informed ones.

        Raises:
            InvalidConfig: if the control share is not in [0, 1].
        """
        # Control pairs are drawn first, so that the informed choice does not bias them.
        k = min(k, len(UnqueriedPairs(len(segment_ids), indices_of(segment_ids, paired))))
        n_control = control_count(k, self._share, self._rng) if view is not None else k
        control = self._control.select(segment_ids, paired, n_control)
        informed: list[tuple[SegmentId, SegmentId]] = []
        if view is not None:
            viewed = segment_ids[: view.n_segments]
            informed = self._informed.select(viewed, [*paired, *control], k - n_control, view)
        if rest := k - len(control) - len(informed):
            control += self._control.select(segment_ids, [*paired, *control, *informed], rest)
        return [ChosenPair(pair, self._control.name) for pair in control] + [
            ChosenPair(pair, self._informed.name) for pair in informed
        ]


_DISAGREEMENT, _ENTROPY = most_uncertain(disagreement), most_uncertain(entropy)
_STAGES: dict[SelectorName, tuple[Stage, ...]] = {
    "uniform": (),
    "recent": (),
    "disagreement": (_DISAGREEMENT,),
    "entropy": (_ENTROPY,),
    "k_center": (farthest,),
    "disagreement_k_center": (_DISAGREEMENT, farthest),
    "entropy_k_center": (_ENTROPY, farthest),
}


def selector_names() -> tuple[SelectorName, ...]:
    """The names that `make_selector` accepts."""
    return tuple(_STAGES)


def make_selector(
    name: SelectorName, rng: np.random.Generator, *, propose: QuerySelector | None = None
) -> QuerySelector:
    """Make the selector with this name.

    Args:
        rng: source of all randomness.
        propose: draws the candidate pairs of a selector that needs a view; uniform if None.

    Raises:
        UnknownSelector: if no selector has this name.
    """
    if stages := _stages_of(name):
        return CandidateSelector(name, propose or UniformSelector(rng), stages)
    return RecentSelector(rng) if name == "recent" else UniformSelector(rng)


def needs_view(name: SelectorName) -> bool:
    """Whether the selector needs a `SegmentView`."""
    return bool(_stages_of(name))


def needs_ensemble(name: SelectorName) -> bool:
    """Whether the selector needs `SegmentView.scores`."""
    return not {_DISAGREEMENT, _ENTROPY}.isdisjoint(_stages_of(name))


def needs_features(name: SelectorName) -> bool:
    """Whether the selector needs `SegmentView.features`."""
    return farthest in _stages_of(name)


def _stages_of(name: SelectorName) -> tuple[Stage, ...]:
    if name not in _STAGES:
        raise UnknownSelector(name, selector_names())
    return _STAGES[name]
