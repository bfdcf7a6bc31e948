"""How unsure an ensemble is of pairs: two measures of the same probabilities."""

import numpy as np
from numpy.typing import NDArray

from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.selection.protocol import FloatArray, IntArray


def disagreement(scores: FloatArray, pairs: IntArray) -> FloatArray:
    """Standard deviation over the M members of P(first preferred) for pairs (K, 2) of scored segments (M, S); (K,).

    High where members learned different things from the same labels: what a label can settle (Christiano et al. 2017).
    """
    return _probabilities(_logits(scores, pairs)).std(axis=0)


def entropy(scores: FloatArray, pairs: IntArray) -> FloatArray:
    """Mean over the M members of the entropy of P(first preferred), nats; (K,).

    High where members agree that the two are alike, too: a label there may be a toss-up (B-Pref's entropy sampling).
    """
    logits = _logits(scores, pairs)
    # H(sigmoid(x)) without the logarithm of a probability, which may be 0
    return (np.logaddexp(0.0, logits) - logits * _probabilities(logits)).mean(axis=0)


def _logits(scores: FloatArray, pairs: IntArray) -> FloatArray:
    scores = scores.astype(np.float64)
    return scores[:, pairs[:, 0]] - scores[:, pairs[:, 1]]


def _probabilities(logits: FloatArray) -> FloatArray:
    return 0.5 * (1.0 + np.tanh(0.5 * logits))


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


def segment_features(segments: SegmentArrays) -> NDArray[np.float32]:
    """Mean and deviation over a segment's real steps of everything its agents see and do: (S, 2 * N * (C + A)).

    B-Pref compares whole flattened segments, by which a gait and the same gait half a stride later are strangers. These
    say where a team is and how much it moves, whatever the phase, with 1/T of the numbers.
    """
    steps = np.concatenate((segments.observations, segments.actions), axis=3)
    steps = steps.reshape(*steps.shape[:2], -1)
    weights = segments.mask / segments.mask.sum(axis=1, keepdims=True)
    mean = np.einsum("st,stf->sf", weights, steps)
    variance = np.einsum("st,stf->sf", weights, (steps - mean[:, None]) ** 2)
    return np.concatenate((mean, np.sqrt(variance)), axis=1).astype(np.float32)
