"""A uniform share beside an informed choice: what shows whether the choice was worth it."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import floor
from typing import Generic

import numpy as np

from mapt.errors import InvalidConfig
from mapt.preferences.selection.pairs import FreePairs, places_of
from mapt.preferences.selection.protocol import QuerySelector, SegmentId, SegmentView, SelectorName


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
