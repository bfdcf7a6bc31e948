"""How good a reward model is on segments it was not trained on."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mapt.preferences.dataset import SegmentArrays
from mapt.rewards.fitting import judge_logits
from mapt.rewards.metrics import correlation, rank_correlation
from mapt.rewards.model import RewardModel
from mapt.rewards.segment_reader import EVALUATION_SEGMENTS

#: what part of the test segments, the newest, counts as late
LATE_SHARE = 0.2


@dataclass(frozen=True, slots=True)
class Predictions:
    """What a model says of S segments."""

    #: float32 (S,)
    scores: NDArray[np.float32]
    #: r-hat, float32 (S, T, N)
    agent_rewards: NDArray[np.float32]
    #: how much each step counts, float32 (S, T)
    weights: NDArray[np.float32]

    @property
    def rewards(self) -> NDArray[np.float32]:
        """r-hat of the team, (S, T): the mean over agents."""
        return self.agent_rewards.mean(axis=2)


@torch.inference_mode()
def predict(model: RewardModel, segments: SegmentArrays) -> Predictions:
    """Run `model`, on the CPU, over segments, some at a time."""
    arrays = (segments.observations, segments.actions, segments.mask)
    parts = zip(*(torch.as_tensor(array).split(EVALUATION_SEGMENTS) for array in arrays), strict=True)
    outputs = [model(*part) for part in parts]
    return Predictions(
        torch.cat([output.score for output in outputs]).numpy(),
        torch.cat([output.agent_rewards for output in outputs]).numpy(),
        torch.cat([output.weights for output in outputs]).numpy(),
    )


def preference_quality(logits: NDArray[np.floating], labels: NDArray[np.floating]) -> dict[str, float]:
    """`accuracy`, `loss` (nats) and `ece` of predicted logits (P,) against labels (P,), NaN where skipped."""
    given = np.isfinite(labels)
    judged = judge_logits(torch.as_tensor(logits[given]).double(), torch.as_tensor(labels[given]).double())
    return {"accuracy": judged.accuracy, "loss": judged.loss, "ece": judged.calibration_error}


def reward_quality(
    predictions: Predictions, true_rewards: NDArray[np.floating], mask: NDArray[np.bool_]
) -> dict[str, float]:
    """Agreement with the true reward (S, T) of segments in the order they were made; mask (S, T).

    Returns:
        `rank_correlation` of scores and true returns (Spearman), `step_correlation` of r-hat_t and the true reward
        over all real steps (Pearson), `step_correlation_within` after taking each segment's mean away from both, and
        `rank_correlation_late` and `step_correlation_late` over the newest fifth.
    """
    true = np.where(mask, true_rewards, 0.0)
    learned = np.where(mask, predictions.rewards, 0.0)
    returns, scores = true.sum(axis=1), predictions.scores
    late = slice(round(len(returns) * (1 - LATE_SHARE)), None)
    return {
        "rank_correlation": rank_correlation(scores, returns),
        "rank_correlation_late": rank_correlation(scores[late], returns[late]),
        "step_correlation": correlation(learned[mask], true[mask]),
        "step_correlation_within": correlation(_centred(learned, mask)[mask], _centred(true, mask)[mask]),
        "step_correlation_late": correlation(learned[late][mask[late]], true[late][mask[late]]),
    }


def _centred(steps: NDArray[np.floating], mask: NDArray[np.bool_]) -> NDArray[np.floating]:
    return steps - steps.sum(axis=1, keepdims=True) / mask.sum(axis=1, keepdims=True)
