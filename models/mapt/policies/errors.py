"""What can go wrong with a policy.

PolicyError
├── InvalidConfig
├── InvalidRewards
├── InvalidCheckpoint
└── TrainingDiverged
"""


class PolicyError(Exception):
    """A policy could not be made, trained or restored."""


class InvalidConfig(PolicyError, ValueError):
    """A setting is unknown, of the wrong type or out of its range."""


class InvalidRewards(PolicyError, ValueError):
    """Rewards of the wrong shape, or not finite."""


class InvalidCheckpoint(PolicyError, ValueError):
    """A checkpoint is damaged, or belongs to another task or another configuration."""


class TrainingDiverged(PolicyError):
    """A gradient was no longer finite. The learner is as it was before the update's last step."""
