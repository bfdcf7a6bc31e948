"""Reward models learned from preferences: MAPT, its training, its checkpoints, and rewards of whole rollouts.

A name of this package is imported when it is first used; all but the settings need torch.
"""

from typing import TYPE_CHECKING

from mapt.lazy import lazy_attributes

if TYPE_CHECKING:
    from mapt.rewards.checkpoints import LoadedRewardModel, SavedRewardModel, load_reward_model, save_reward_model
    from mapt.rewards.config import MODEL_NAMES, RewardConfig, TrainConfig
    from mapt.rewards.inspection import predict
    from mapt.rewards.layers import LocalAttention, drop_context
    from mapt.rewards.model import FirstLayers, RewardModel, RewardNetwork, RewardOutput
    from mapt.rewards.relabelling import RolloutRelabeller
    from mapt.rewards.trainer import TrainedReward, train_reward_model
    from mapt.rewards.wrappers.gymnasium import LearnedReward, LearnedVectorReward
    from mapt.rewards.wrappers.pettingzoo import LearnedParallelReward

__all__ = [
    "MODEL_NAMES",
    "FirstLayers",
    "LearnedParallelReward",
    "LearnedReward",
    "LearnedVectorReward",
    "LoadedRewardModel",
    "LocalAttention",
    "RewardConfig",
    "RewardModel",
    "RewardNetwork",
    "RewardOutput",
    "RolloutRelabeller",
    "SavedRewardModel",
    "TrainConfig",
    "TrainedReward",
    "drop_context",
    "load_reward_model",
    "predict",
    "save_reward_model",
    "train_reward_model",
]

_MODULE_OF = {
    "LoadedRewardModel": "checkpoints",
    "SavedRewardModel": "checkpoints",
    "load_reward_model": "checkpoints",
    "save_reward_model": "checkpoints",
    "MODEL_NAMES": "config",
    "RewardConfig": "config",
    "TrainConfig": "config",
    "predict": "inspection",
    "LocalAttention": "layers",
    "drop_context": "layers",
    "FirstLayers": "model",
    "RewardModel": "model",
    "RewardNetwork": "model",
    "RewardOutput": "model",
    "RolloutRelabeller": "relabelling",
    "TrainedReward": "trainer",
    "train_reward_model": "trainer",
    "LearnedReward": "wrappers.gymnasium",
    "LearnedVectorReward": "wrappers.gymnasium",
    "LearnedParallelReward": "wrappers.pettingzoo",
}

__getattr__ = lazy_attributes(__name__, _MODULE_OF)
