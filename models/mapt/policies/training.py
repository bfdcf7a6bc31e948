"""Training with any reward."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mapt.policies.learner import Learner
from mapt.policies.rollout import Rollout

#: Rewards (L, E) or (L, E, N) of a rollout.
RewardFunction = Callable[[Rollout], NDArray[np.floating]]
#: Called after each update with the learner, its rollout and the update's metrics; True ends the training.
Callback = Callable[[Learner, Rollout, dict[str, float]], bool | None]


def true_reward(rollout: Rollout) -> NDArray[np.floating]:
    """The task's own reward (L, E)."""
    return rollout.rewards


def train(
    learner: Learner, reward_function: RewardFunction, total_steps: int, callback: Callback | None = None
) -> None:
    """Collect, reward and update until the learner has seen `total_steps` environment steps.

    A learner that has seen some already goes on from there.
    """
    while learner.steps < total_steps:
        rollout = learner.collect()
        metrics = learner.update(rollout, reward_function(rollout))
        if callback is not None and callback(learner, rollout, metrics):
            return
