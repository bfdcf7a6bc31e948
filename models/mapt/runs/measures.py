"""What is written down of an iteration, under the names that curves have everywhere."""

import math

import numpy as np
from numpy.typing import NDArray

from mapt.policies import Rollout

#: the learner's names -> the curves'
_RENAMED = {"actor_loss": "policy_loss", "critic_loss": "value_loss"}
_KEPT = ("entropy", "explained_variance", "kl", "clip_fraction", "action_std", "learning_rate")


def iteration_metrics(
    rollout: Rollout, rewards: NDArray[np.floating], losses: dict[str, float], horizon_steps: int
) -> dict[str, float]:
    """The points that one iteration adds to the curves.

    Args:
        rewards: (L, E) or (L, E, N), those the policy learned from.
        losses: what `Learner.update` gave.

    Returns:
        `true_return` if an episode ended, `learned_return` (the mean reward, times an episode's steps: it can be told
        for every rollout), `true_reward_correlation` over the rollout's steps where it is defined, and the losses.
    """
    shared = rewards.mean(axis=2) if rewards.ndim == 3 else rewards
    values = {_RENAMED.get(name, name): value for name, value in losses.items() if name in _RENAMED or name in _KEPT}
    values["learned_return"] = float(shared.mean()) * horizon_steps
    if len(rollout.episode_returns):
        values["true_return"] = float(rollout.episode_returns.mean())
    if (agreement := _correlation(shared, rollout.rewards)) is not None:
        values["true_reward_correlation"] = agreement
    return values


def _correlation(first: NDArray[np.floating], second: NDArray[np.floating]) -> float | None:
    left, right = (values.astype(np.float64).ravel() - values.mean() for values in (first, second))
    scale = math.sqrt(float((left**2).sum()) * float((right**2).sum()))
    return float((left * right).sum()) / scale if scale > 0 else None
