"""Which pairs to ask about next: uniform, with an eye on what the policy does now."""

from collections.abc import Collection, Sequence

import numpy as np

from mapt.preferences.selection import UniformSelector

#: the newest share of the pool counts as recent, at least so many segments
RECENT_SHARE = 0.25
FEWEST_RECENT = 16


def choose_pairs(
    segment_ids: Sequence[str],
    paired: Collection[frozenset[str]],
    k: int,
    *,
    first_round: bool,
    rng: np.random.Generator,
) -> list[tuple[str, str]]:
    """Draw up to k pairs that were never asked about.

    The first round draws from all segments alike. Later, half of the pairs compare two recent segments and half a
    recent one with any: labels on what the policy does now matter most, and a bridge to older behaviour keeps the
    reward's scale.

    Args:
        segment_ids: the pool, newest first.
        paired: pairs that have a query, in either order.
    """
    known = [(min(pair), max(pair)) for pair in paired]
    uniform = UniformSelector(rng)
    if first_round:
        return uniform.select(segment_ids, known, k)
    recent = segment_ids[: max(FEWEST_RECENT, round(len(segment_ids) * RECENT_SHARE))]
    chosen = uniform.select(recent, [pair for pair in known if set(pair) <= set(recent)], k // 2)
    chosen += _bridges(recent, segment_ids, {frozenset(pair) for pair in [*known, *chosen]}, k - len(chosen), rng)
    # A small pool may hold no such pair any more.
    rest = k - len(chosen)
    return chosen + uniform.select(segment_ids, [*known, *chosen], rest) if rest else chosen


def _bridges(
    recent: Sequence[str], pool: Sequence[str], taken: set[frozenset[str]], k: int, rng: np.random.Generator
) -> list[tuple[str, str]]:
    chosen: list[tuple[str, str]] = []
    for _ in range(20 * k):
        if len(chosen) == k:
            break
        pair = [recent[int(rng.integers(len(recent)))], pool[int(rng.integers(len(pool)))]]
        if pair[0] == pair[1] or frozenset(pair) in taken:
            continue
        taken.add(frozenset(pair))
        first = int(rng.integers(2))
        chosen.append((pair[first], pair[1 - first]))
    return chosen
