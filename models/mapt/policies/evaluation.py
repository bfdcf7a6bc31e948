"""Measuring a policy by the true reward."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mapt.policies.learner import Learner
from mapt.policies.networks import Policy
from mapt.policies.rollout import available_actions
from mapt.tasks import Task


@dataclass(frozen=True, slots=True)
class Episodes:
    """Whole episodes."""

    #: (episodes,) true returns
    returns: NDArray[np.float64]
    #: (episodes,) steps
    lengths: NDArray[np.int64]


def play(
    policy: Learner | Policy, task: Task, episodes: int = 32, *, deterministic: bool = True, seed: int = 0
) -> Episodes:
    """Whole episodes on a task of its own, which is reset.

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
    # Environments that are done early play on into the spare last row.
    returns = np.zeros((n_rounds + 1, task.n_envs))
    lengths = np.zeros((n_rounds + 1, task.n_envs), dtype=np.int64)
    played = np.zeros(task.n_envs, dtype=np.intp)
    envs = np.arange(task.n_envs)
    observations, _ = task.reset(seed)
    while played.min() < n_rounds:
        noise = None if deterministic else acting.noise((), task.n_envs, generator)
        step = task.step(acting.act(observations, noise, available_actions(task)))
        returns[played, envs] += step.reward
        lengths[played, envs] += 1
        played = np.minimum(played + (step.terminated | step.truncated), n_rounds)
        observations = step.observations
    return Episodes(returns[:n_rounds].ravel()[:episodes], lengths[:n_rounds].ravel()[:episodes])


def evaluate(
    policy: Learner | Policy, task: Task, episodes: int = 32, *, deterministic: bool = True, seed: int = 0
) -> NDArray[np.float64]:
    """True returns (episodes,) of `play`."""
    return play(policy, task, episodes, deterministic=deterministic, seed=seed).returns
