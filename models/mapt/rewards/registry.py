"""Builds any reward model from its config."""

from mapt.rewards.baselines import JointTransformer, MarkovRewards, RecurrentRewards
from mapt.rewards.config import RewardConfig
from mapt.rewards.mapt import MAPT
from mapt.rewards.model import RewardNetwork

_ARCHITECTURES: dict[str, type[RewardNetwork]] = {
    "mapt": MAPT,
    "mlp": MarkovRewards,
    "lstm": RecurrentRewards,
    "transformer": JointTransformer,
}


def build_reward_model(config: RewardConfig) -> RewardNetwork:
    """A new model of `config`, its weights drawn from torch's global generator."""
    return _ARCHITECTURES[config.architecture](config)
