"""The Bradley-Terry model on segment scores."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from mapt.errors import ShapeError

# A model this sure of a pair, and right, has nothing more to learn from it. Gradients of e^-90 and less would become
# denormal numbers on their way through the network, and a CPU takes ten times as long over those: on 1,050 labels of an
# oracle, with differences of scores up to 200, they were half of the time of a training.
SURE_LOGIT = 30.0


def preference_loss(score_0: Tensor, score_1: Tensor, label: Tensor, label_noise: float = 0.0) -> Tensor:
    """Mean cross-entropy, in nats, between labels and the Bradley-Terry probabilities (paper, eq. 2 and 3).

    The difference of the scores is the logit, so the loss stays finite however far apart they are.

    Args:
        score_0, score_1: segment scores, float32 (B,).
        label: P(segment 0 preferred), float32 (B,): 1, 0, 0.5 or anything between.
        label_noise: see `preference_losses`.

    Raises:
        ShapeError: if the three shapes differ.
    """
    if score_1.shape != score_0.shape:
        raise ShapeError("score_1", tuple(score_1.shape), f"that of score_0, {tuple(score_0.shape)}")
    if label.shape != score_0.shape:
        raise ShapeError("label", tuple(label.shape), f"that of the scores, {tuple(score_0.shape)}")
    return preference_losses(score_0 - score_1, label, label_noise).mean()


def preference_losses(logits: Tensor, label: Tensor, label_noise: float = 0.0) -> Tensor:
    """Cross-entropy of each pair, in nats, (B,).

    Args:
        logits: score_0 - score_1, (B,).
        label: as in `preference_loss`.
        label_noise: the share e of labels that are taken to be mistakes. A label is then explained by
            (1 - e) P + e (1 - P), so that a pair on which the model is sure, and the label wrong, costs at most
            log(1 / e) and pulls no more (Christiano et al. 2017 take e = 0.1 of every human label).
    """
    return -(label * _log_likelihood(logits, label_noise) + (1 - label) * _log_likelihood(-logits, label_noise))


def _log_likelihood(logits: Tensor, noise: float) -> Tensor:
    """log((1 - e) sigmoid(x) + e sigmoid(-x)), without the sigmoids; flat where the model is sure."""
    if noise == 0.0:
        return F.logsigmoid(logits.clamp(max=SURE_LOGIT))
    logits = logits.clamp(-SURE_LOGIT, SURE_LOGIT)
    return torch.logaddexp(F.logsigmoid(logits) + math.log1p(-noise), F.logsigmoid(-logits) + math.log(noise))
