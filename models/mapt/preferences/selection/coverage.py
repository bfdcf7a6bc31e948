"""k-center: pairs far from every pair asked about, and from each other."""

import numpy as np

from mapt.preferences.selection.protocol import FloatArray, IntArray

#: asked pairs compared at once: bounds the memory at (candidates, so many) numbers
_CHUNK_PAIRS = 1024


def k_center(candidates: FloatArray, asked: FloatArray, k: int) -> IntArray:
    """The greedy k-center rule: always the candidate whose nearest pair, asked or chosen, is farthest away.

    The distance of two pairs does not depend on which segment comes first:
    d({a, b}, {c, d})^2 = min(|a-c|^2 + |b-d|^2, |a-d|^2 + |b-c|^2), the shortest over both ways to match them.
    Costs O(candidates * (asked + k) * F).

    Args:
        candidates: features of the pairs to choose among, (K, 2, F).
        asked: features of the pairs to keep away from, (P, 2, F).

    Returns:
        Places (min(k, K),) in `candidates` in the order of choice. Where nothing was asked about, the first is 0.
    """
    candidates, asked = candidates.astype(np.float64), asked.astype(np.float64)
    nearest = np.full(len(candidates), np.inf)
    for start in range(0, len(asked), _CHUNK_PAIRS):
        nearest = np.minimum(nearest, _squared_distances(candidates, asked[start : start + _CHUNK_PAIRS]).min(axis=1))
    chosen = np.empty(min(k, len(candidates)), dtype=np.int64)
    for turn in range(len(chosen)):
        chosen[turn] = place = int(nearest.argmax())
        nearest = np.minimum(nearest, _squared_distances(candidates, candidates[place, None])[:, 0])
        # below every distance, those of copies of it among them
        nearest[chosen[: turn + 1]] = -1.0
    return chosen


def scaled(features: FloatArray, asked: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both in units of the deviation of `features` (S, F) over the segments, so that no unit of measure decides.

    A feature in which the segments are alike is left as it is.
    """
    deviation = features.std(axis=0)
    deviation[deviation == 0.0] = 1.0
    return features / deviation, asked / deviation


def _squared_distances(pairs: FloatArray, others: FloatArray) -> FloatArray:
    """Between pairs (K, 2, F) and others (P, 2, F): (K, P)."""
    squares = (pairs**2).sum(axis=2)[:, None, :, None] + (others**2).sum(axis=2)[None, :, None, :]
    # (K, P, 2, 2): segment i of the one to segment j of the other
    products = np.tensordot(pairs, others, axes=(2, 2)).transpose(0, 2, 1, 3)
    distances = np.maximum(squares - 2.0 * products, 0.0)
    straight = distances[..., 0, 0] + distances[..., 1, 1]
    crossed = distances[..., 0, 1] + distances[..., 1, 0]
    return np.minimum(straight, crossed)
