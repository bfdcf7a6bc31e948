"""Multi-agent policies and how they learn from any reward."""

from mapt.policies.config import Algorithm, PolicyConfig
from mapt.policies.errors import InvalidCheckpoint, InvalidConfig, InvalidRewards, PolicyError, TrainingDiverged
from mapt.policies.evaluation import Episodes, evaluate, play
from mapt.policies.learner import Learner
from mapt.policies.policy import Policy
from mapt.policies.rollout import Rollout
from mapt.policies.training import train, true_reward

__all__ = [
    "Algorithm",
    "Episodes",
    "InvalidCheckpoint",
    "InvalidConfig",
    "InvalidRewards",
    "Learner",
    "Policy",
    "PolicyConfig",
    "PolicyError",
    "Rollout",
    "TrainingDiverged",
    "evaluate",
    "play",
    "train",
    "true_reward",
]
