"""Reward models by their settings.

`RewardModel` is what training, relabelling and storage know of a model; `build_reward_model` makes any of them.
"""

from mapt.rewards.baselines import JointTransformer, MarkovRewards, RecurrentRewards
from mapt.rewards.config import RewardConfig
from mapt.rewards.mapt import MAPT
from mapt.rewards.model import PolicyReward, RewardModel, RewardOutput

__all__ = ["PolicyReward", "RewardModel", "RewardOutput", "build_reward_model"]

_ARCHITECTURES: dict[str, type[RewardModel]] = {
    "mapt": MAPT,
    "mlp": MarkovRewards,
    "lstm": RecurrentRewards,
    "transformer": JointTransformer,
}


def build_reward_model(config: RewardConfig) -> RewardModel:
    """A new model of these settings, its weights drawn from torch's global generator."""
    return _ARCHITECTURES[config.architecture](config)
