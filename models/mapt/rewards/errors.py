"""What can go wrong with reward models.

RewardModelError
├── InvalidConfig
├── ModelMismatch
├── InvalidRollout
└── CheckpointError
    ├── DamagedCheckpoint
    └── NewerCheckpoint
"""


class RewardModelError(ValueError):
    """A reward model cannot be built, trained, read or used as asked."""


class InvalidConfig(RewardModelError):
    """A setting is unknown, missing or out of its range."""


class ModelMismatch(RewardModelError):
    """A model is used with data, or in place of a model, of other dimensions."""

    def __init__(self, what: str, expected: object, found: object) -> None:
        super().__init__(f"{what}: the model was built for {expected}, not {found}")


class InvalidRollout(RewardModelError):
    """Arrays of a rollout, or the context kept from the last one, have the wrong shape or are not finite."""


class CheckpointError(RewardModelError):
    """A stored reward model cannot be read."""


class DamagedCheckpoint(CheckpointError):
    """A stored reward model is incomplete or altered, or is none."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"This is no whole reward model: {reason}")


class NewerCheckpoint(CheckpointError):
    """A stored reward model was written by a later version of this library."""

    def __init__(self, found: int, known: int) -> None:
        super().__init__(f"This reward model has format {found}; this version reads up to {known}. Update to read it.")
