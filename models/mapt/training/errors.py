"""What can go wrong with a run.

RunError
├── InvalidRun
├── OtherRun
├── RunBusy
├── RunNotFound
└── DamagedRun
"""

from collections.abc import Sequence
from pathlib import Path


class RunError(ValueError):
    """A run cannot be trained, evaluated or shown as asked."""


class InvalidRun(RunError):
    """A setting of a run is unknown or out of its range."""


class OtherRun(RunError):
    """The folder holds a run with other settings."""

    def __init__(self, folder: Path, differences: Sequence[str]) -> None:
        super().__init__(f"{folder} holds another run ({'; '.join(differences)}). Give another --output.")


class RunBusy(RunError):
    """Another process trains in this folder."""

    def __init__(self, folder: Path) -> None:
        super().__init__(f"Another process is training in {folder}.")


class RunNotFound(RunError):
    """There is no run, or no checkpoint of one, at this path."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path} holds no run and is no checkpoint; `mapt train` makes one")


class DamagedRun(RunError):
    """A file of a run is not as it was written."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path} cannot be read: {reason}")
