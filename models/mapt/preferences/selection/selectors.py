"""B-Pref's query selectors by name, and a mix of a selector with uniform control pairs."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from math import floor
from typing import Generic

import numpy as np

from mapt.errors import InvalidConfig, MissingView, UnknownSelector
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
    """Draws pairs that were not queried before, uniformly."""

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
            raise MissingView("scores")
        # Stable: among equal candidates, the one drawn first.
        return np.argsort(-criterion(view.scores, pairs), kind="stable")[:k]

    return keep


def farthest(view: SegmentView, pairs: IntArray, queried: IntArray, k: int) -> IntArray:
    """The stage that keeps the pairs chosen by `k_center`."""
    if view.features is None:
        raise MissingView("features")
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
    pairs from the same segments reveal this, and are an unbiased test set for the reward model.
    """

    def __init__(
        self, informed: QuerySelector, control: QuerySelector, control_share: float, rng: np.random.Generator
    ) -> None:
        """Make a selector.

        Args:
            informed: chooses by the `SegmentView`.
            control: chooses without a `SegmentView`. While there is no view, as in the first round, it chooses all
                pairs.
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
    """The names that `make_selector` accepts."""
    return tuple(_STAGES)


def make_selector(
    name: SelectorName, rng: np.random.Generator, *, propose: QuerySelector | None = None
) -> QuerySelector:
    """Make the selector with this name.

    Args:
        rng: source of all randomness.
        propose: draws the candidates; uniform if None.

    Raises:
        UnknownSelector: if no selector has this name.
    """
    stages = _stages_of(name)
    propose = propose or UniformSelector(rng)
    return CandidateSelector(name, propose, stages) if stages else propose


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
