"""Which pairs of segments to ask about next. Numpy alone: an ensemble's scores come in as an array.

`make_selector(name, rng)` gives a selector by name; `ControlledSelector` holds out a uniform share beside it.
"""

from mapt.preferences.selection.criteria import segment_features
from mapt.preferences.selection.protocol import QuerySelector, SegmentView, SelectorName
from mapt.preferences.selection.selectors import (
    ChosenPair,
    ControlledSelector,
    UniformSelector,
    control_count,
    make_selector,
    needs_ensemble,
    needs_features,
    selector_names,
)

__all__ = [
    "ChosenPair",
    "ControlledSelector",
    "QuerySelector",
    "SegmentView",
    "SelectorName",
    "UniformSelector",
    "control_count",
    "make_selector",
    "needs_ensemble",
    "needs_features",
    "segment_features",
    "selector_names",
]
