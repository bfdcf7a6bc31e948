"""Reward models for benchmarks, with the cost of a trained model."""

from mapt.rewards.config import RewardConfig
from mapt.rewards.model import RewardModel
from mapt.rewards.registry import build_reward_model


def model_with_active_attention(config: RewardConfig) -> RewardModel:
    """A model with a random output head.

    The output head of a new model is zero, so its attention path is skipped and would cost nothing.
    """
    model = build_reward_model(config)
    model.load_state_dict(model.with_new_head())
    return model
