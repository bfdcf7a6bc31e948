"""Reward models as they are once their attention path has been trained."""

from mapt.rewards.config import RewardConfig
from mapt.rewards.model import RewardModel
from mapt.rewards.registry import build_reward_model


def awake_model(config: RewardConfig) -> RewardModel:
    """An untrained one whose attention path is not silent: of a silent one, as every one begins, nothing is run."""
    model = build_reward_model(config)
    model.load_state_dict(model.with_new_head())
    return model
