"""Reward models for training runs that are small enough for a test."""

from pathlib import Path

import torch

from mapt.rewards.checkpoints import save_reward_model
from mapt.rewards.config import RewardConfig
from mapt.rewards.model import RewardModel
from mapt.rewards.registry import build_reward_model
from mapt.tasks import task_spec
from mapt.training.settings import LearnedRewardSettings
from support.short_tasks import SHORTEST_NAME

#: environments times rollout steps
STEPS_PER_ITERATION = 4 * 24
SEGMENT_STEPS = 5
#: metrics that differ between runs with equal settings
TIMINGS = ("time", "steps_per_second", "seconds_physics", "seconds_inference", "seconds_reward", "seconds_update")


def reward_model(seed: int = 0, mean: float = 0.0, deviation: float = 1.0) -> RewardModel:
    """An untrained reward of the short task."""
    spec = task_spec(SHORTEST_NAME)
    config = RewardConfig(
        observation_dim=spec.observation_dim,
        action_dim=spec.action_dim,
        n_agents=spec.n_agents,
        hidden_dim=8,
        heads=1,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = build_reward_model(config).eval()
    model.set_reward_scale(mean, deviation)
    return model


def write_reward(folder: Path, model: RewardModel, segment_steps: int | None = SEGMENT_STEPS) -> LearnedRewardSettings:
    """Write a version, in place of the one that is there."""
    save_reward_model(model, {}, segment_steps=segment_steps).write(folder)
    return LearnedRewardSettings(str(folder), SEGMENT_STEPS)
