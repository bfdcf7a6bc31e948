"""Training with any reward, and measuring with the true one."""

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from mapt.policies.learner import Learner
from mapt.policies.policy import Policy
from mapt.policies.rollout import Rollout, available_actions
from mapt.tasks import Task

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


def evaluate(
    policy: Learner | Policy, task: Task, episodes: int = 32, *, deterministic: bool = True, seed: int = 0
) -> NDArray[np.float64]:
    """True returns (episodes,) of whole episodes on a task of its own, which is reset.

    Each environment plays the same number of episodes, so short ones are not counted more often than long ones.

    Args:
        policy: a learner's, or the learner itself.
        task: of the same specification, with any number of environments; not the learner's own.
        deterministic: take the mean or the likeliest action instead of a draw.
        seed: decides starts and draws.
    """
    acting = policy.policy if isinstance(policy, Learner) else policy
    generator = torch.Generator().manual_seed(seed)
    n_rounds = math.ceil(episodes / task.n_envs)
    returns = np.zeros((n_rounds + 1, task.n_envs))
    played = np.zeros(task.n_envs, dtype=np.intp)
    envs = np.arange(task.n_envs)
    observations, _ = task.reset(seed)
    while played.min() < n_rounds:
        noise = None if deterministic else acting.noise((), task.n_envs, generator)
        step = task.step(acting.act(observations, noise, available_actions(task)))
        # Environments that are done early play on into the spare last row.
        returns[played, envs] += step.reward
        played = np.minimum(played + (step.terminated | step.truncated), n_rounds)
        observations = step.observations
    return returns[:n_rounds].ravel()[:episodes]
