"""Every pair with the same probability."""

from collections.abc import Collection, Sequence

import numpy as np

from mapt.preferences.selection.pairs import FreePairs, places_of
from mapt.preferences.selection.protocol import SegmentId, SegmentView, SelectorName


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
