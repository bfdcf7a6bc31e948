"""Every pair with the same probability."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from math import floor
from typing import Generic

import numpy as np

from mapt.errors import InvalidConfig, MissingView, UnknownSelector
from mapt.preferences.selection.criteria import disagreement, entropy, k_center, scaled
from mapt.preferences.selection.protocol import (
    FloatArray,
    FreePairs,
    IntArray,
    QuerySelector,
    SegmentId,
    SegmentView,
    SelectorName,
    places_of,
)


class UniformSelector:
    """Draws every pair not asked about yet with the same probability."""

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
        free = FreePairs(len(segment_ids), places_of(segment_ids, paired))
        return [(segment_ids[first], segment_ids[second]) for first, second in free.draw(k, self._rng).tolist()]


#: candidates drawn for each query wanted (B-Pref's large_batch)
CANDIDATES_PER_QUERY = 10
#: the share of the candidates that a stage leaves to the next one (B-Pref)
KEPT_SHARE = 0.5

#: (view, candidate pairs (K, 2), asked pairs (P, 2), k) -> places in the candidates of the k best, best first
Stage = Callable[[SegmentView, IntArray, IntArray, int], IntArray]


class CandidateSelector:
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
            raise MissingView("scores")
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


@dataclass(frozen=True, slots=True)
class ChosenPair(Generic[SegmentId]):
    """A pair, and how it was chosen."""

    pair: tuple[SegmentId, SegmentId]
    selector: SelectorName


def control_count(k: int, share: float, rng: np.random.Generator) -> int:
    """How many of k pairs are control ones: k * share on average, and never off by one or more.

    Raises:
        InvalidConfig: unless the share lies in [0, 1].
    """
    if not 0.0 <= share <= 1.0:
        raise InvalidConfig(f"the control share is {share}; it must lie in [0, 1]", "share")
    return min(k, floor(k * share + rng.random()))


class ControlledSelector:
    """Chooses most pairs by one selector and a share of every batch by another, and says which is which.

    Uncertainty sampling sometimes does worse than drawing at random, for it may chase what cannot be learned. Only
    pairs drawn at random from the same segments can tell; they measure the reward model without bias besides.
    """

    def __init__(
        self, informed: QuerySelector, control: QuerySelector, control_share: float, rng: np.random.Generator
    ) -> None:
        """
        Args:
            control: chooses without a view; it is the whole choice while there is none, as in the first round.
            control_share: of every batch, in [0, 1].
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
        """Choose up to k pairs; arguments, number and errors as in `QuerySelector.select`.

        Returns:
            The control's pairs first, then the informed ones.

        Raises:
            InvalidConfig: unless the control share lies in [0, 1].
        """
        # The control goes first and is drawn from all pairs that are free: what the other takes does not skew it.
        k = min(k, len(FreePairs(len(segment_ids), places_of(segment_ids, paired))))
        n_control = control_count(k, self._share, self._rng) if view is not None else k
        control = self._control.select(segment_ids, paired, n_control)
        informed: list[tuple[SegmentId, SegmentId]] = []
        if view is not None:
            informed = self._informed.select(segment_ids, [*paired, *control], k - n_control, view)
        return [ChosenPair(pair, self._control.name) for pair in control] + [
            ChosenPair(pair, self._informed.name) for pair in informed
        ]


_DISAGREEMENT, _ENTROPY = most_uncertain(disagreement), most_uncertain(entropy)
_STAGES: dict[SelectorName, tuple[Stage, ...]] = {
    "uniform": (),
    "disagreement": (_DISAGREEMENT,),
    "entropy": (_ENTROPY,),
    "k_center": (farthest,),
    "disagreement_k_center": (_DISAGREEMENT, farthest),
    "entropy_k_center": (_ENTROPY, farthest),
}


def selector_names() -> tuple[SelectorName, ...]:
    """Every name that `make_selector` knows."""
    return tuple(_STAGES)


def make_selector(
    name: SelectorName, rng: np.random.Generator, *, propose: QuerySelector | None = None
) -> QuerySelector:
    """The selector of this name.

    Args:
        rng: decides all its chance.
        propose: draws the candidates of those that choose among some; uniform when not given.

    Raises:
        UnknownSelector: naming the known ones.
    """
    stages = _stages_of(name)
    propose = propose or UniformSelector(rng)
    return CandidateSelector(name, propose, stages) if stages else propose


def needs_ensemble(name: SelectorName) -> bool:
    """Whether it chooses by `SegmentView.scores`."""
    return not {_DISAGREEMENT, _ENTROPY}.isdisjoint(_stages_of(name))


def needs_features(name: SelectorName) -> bool:
    """Whether it chooses by `SegmentView.features`."""
    return farthest in _stages_of(name)


def _stages_of(name: SelectorName) -> tuple[Stage, ...]:
    if name not in _STAGES:
        raise UnknownSelector(name, selector_names())
    return _STAGES[name]
