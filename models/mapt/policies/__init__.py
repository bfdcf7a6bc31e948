"""Multi-agent policies and how they learn from any reward."""

from mapt.policies.config import MappoConfig
from mapt.policies.errors import InvalidCheckpoint, InvalidConfig, InvalidRewards, PolicyError, TrainingDiverged
from mapt.policies.learner import MappoLearner
from mapt.policies.networks import Actor
from mapt.policies.rollout import Rollout
from mapt.policies.training import evaluate, train, true_reward

__all__ = [
    "Actor",
    "InvalidCheckpoint",
    "InvalidConfig",
    "InvalidRewards",
    "MappoConfig",
    "MappoLearner",
    "PolicyError",
    "Rollout",
    "TrainingDiverged",
    "evaluate",
    "train",
    "true_reward",
]
