"""Query selection: which pairs of segments to label next.

`make_selector(name, rng)` makes one of B-Pref's samplers, or the one that prefers recent segments; `ControlledSelector`
mixes in uniformly drawn control pairs.
The package needs numpy only; callers pass in the ensemble's scores as an array.
"""

from mapt.preferences.selection.criteria import segment_features
from mapt.preferences.selection.protocol import QuerySelector, SegmentView, SelectorName
from mapt.preferences.selection.selectors import (
    ChosenPair,
    ControlledSelector,
    RecentSelector,
    UniformSelector,
    control_count,
    make_selector,
    needs_ensemble,
    needs_features,
    needs_view,
    selector_names,
)

__all__ = [
    "ChosenPair",
    "ControlledSelector",
    "QuerySelector",
    "RecentSelector",
    "SegmentView",
    "SelectorName",
    "UniformSelector",
    "control_count",
    "make_selector",
    "needs_ensemble",
    "needs_features",
    "needs_view",
    "segment_features",
    "selector_names",
]
