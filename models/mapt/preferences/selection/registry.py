"""Selectors by name."""

import numpy as np

from mapt.errors import UnknownSelector
from mapt.preferences.selection.narrowing import NarrowingSelector, Stage, farthest, most_uncertain
from mapt.preferences.selection.protocol import QuerySelector, SelectorName
from mapt.preferences.selection.uncertainty import disagreement, entropy
from mapt.preferences.selection.uniform import UniformSelector

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
    return NarrowingSelector(name, propose, stages) if stages else propose


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
