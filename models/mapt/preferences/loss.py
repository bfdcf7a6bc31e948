"""The Bradley-Terry model on segment scores."""

import torch.nn.functional as F
from torch import Tensor

from mapt.preferences.errors import ShapeError


def preference_loss(score_0: Tensor, score_1: Tensor, label: Tensor) -> Tensor:
    """Mean cross-entropy, in nats, between labels and the Bradley-Terry probabilities (paper, eq. 2 and 3).

    The difference of the scores is the logit, so the loss stays finite however far apart they are.

    Args:
        score_0, score_1: segment scores, float32 (B,).
        label: P(segment 0 preferred), float32 (B,): 1, 0, 0.5 or anything between.

    Raises:
        ShapeError: if the three shapes differ.
    """
    if score_1.shape != score_0.shape:
        raise ShapeError("score_1", tuple(score_1.shape), f"that of score_0, {tuple(score_0.shape)}")
    if label.shape != score_0.shape:
        raise ShapeError("label", tuple(label.shape), f"that of the scores, {tuple(score_0.shape)}")
    return F.binary_cross_entropy_with_logits(score_0 - score_1, label)
