"""How unsure an ensemble is of pairs: two measures of the same probabilities."""

import numpy as np

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
