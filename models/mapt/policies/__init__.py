"""Multi-agent policies (MAPPO, HAPPO, MAT, MAT-Dec) and the learner that trains them with any reward.

Modules that need torch are imported on first use, so that settings can be read and validated without it.
"""

from typing import TYPE_CHECKING

from mapt.lazy import lazy_attributes
from mapt.policies.config import Algorithm, PolicyConfig

if TYPE_CHECKING:
    from mapt.policies.episodes import Episodes, evaluate, play
    from mapt.policies.learner import Learner
    from mapt.policies.networks import Policy
    from mapt.policies.rollout import Rollout

__all__ = [
    "Algorithm",
    "Episodes",
    "Learner",
    "Policy",
    "PolicyConfig",
    "Rollout",
    "evaluate",
    "play",
]

_MODULE_OF = {
    "Episodes": "episodes",
    "Learner": "learner",
    "Policy": "networks",
    "Rollout": "rollout",
    "evaluate": "episodes",
    "play": "episodes",
}

__getattr__ = lazy_attributes(__name__, _MODULE_OF)
