"""Which pairs to ask about next, with an eye on what the policy does now."""

from collections.abc import Collection, Sequence

import numpy as np

from accord.domain.experiment import ExperimentConfig
from mapt.preferences.selection import (
    ChosenPair,
    ControlledSelector,
    SegmentView,
    SelectorName,
    UniformSelector,
    make_selector,
)
from mapt.preferences.selection.protocol import SegmentId

#: the newest share of the pool counts as recent, at least so many segments
RECENT_SHARE = 0.25
FEWEST_RECENT = 16


class RecentPairs:
    """Uniform, but half of the pairs compare two recent segments and half a recent one with any.

    Labels on what the policy does now matter most, and a bridge to older behaviour keeps the reward's scale.
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
        """See `mapt.preferences.selection.QuerySelector.select`; the newest segments come first."""
        recent = segment_ids[: max(FEWEST_RECENT, round(len(segment_ids) * RECENT_SHARE))]
        chosen = self._uniform.select(recent, paired, k // 2)
        taken = {frozenset(pair) for pair in [*paired, *chosen]}
        chosen += self._bridges(recent, segment_ids, taken, k - len(chosen))
        # A small pool may hold no such pair any more.
        rest = k - len(chosen)
        return chosen + self._uniform.select(segment_ids, [*paired, *chosen], rest) if rest else chosen

    def _bridges(
        self, recent: Sequence[SegmentId], pool: Sequence[SegmentId], taken: set[frozenset[SegmentId]], k: int
    ) -> list[tuple[SegmentId, SegmentId]]:
        chosen: list[tuple[SegmentId, SegmentId]] = []
        for _ in range(20 * k):
            if len(chosen) == k:
                break
            new, other = recent[int(self._rng.integers(len(recent)))], pool[int(self._rng.integers(len(pool)))]
            if new == other or frozenset((new, other)) in taken:
                continue
            taken.add(frozenset((new, other)))
            chosen.append((new, other) if self._rng.integers(2) else (other, new))
        return chosen


def choose_pairs(
    config: ExperimentConfig,
    segment_ids: Sequence[str],
    paired: Collection[frozenset[str]],
    k: int,
    *,
    view: SegmentView | None,
    first_round: bool,
    rng: np.random.Generator,
) -> list[ChosenPair[str]]:
    """Choose up to k pairs that were never asked about, each with how it was chosen.

    The first round draws from all segments alike; so does, but for `RecentPairs`, every round without a view.

    Args:
        segment_ids: the pool, newest first.
        paired: pairs that have a query, in either order.
        view: what is known of the first of `segment_ids`, as many as it tells of; the others are chosen only when
            those are used up.

    Raises:
        mapt.preferences.selection.UnknownSelector: if `config.query_selection` is none.
    """
    known = [(min(pair), max(pair)) for pair in paired]
    control = UniformSelector(rng) if first_round else RecentPairs(rng)
    informed = make_selector(config.query_selection, rng, propose=control)
    chosen: list[ChosenPair[str]] = []
    if view is not None:
        selector = ControlledSelector(informed, control, config.control_share, rng)
        chosen = selector.choose(segment_ids[: view.n_segments], known, k, view)
    rest = control.select(segment_ids, [*known, *(each.pair for each in chosen)], k - len(chosen))
    return chosen + [ChosenPair(pair, control.name) for pair in rest]
