"""What can go wrong with a study.

StudyError
├── InvalidStudy
├── ReplayError
│   ├── ReplayNotFound
│   └── NoTrueRewards
├── DamagedCell
├── RecordingStopped
└── TooFewLabels
"""

from pathlib import Path


class StudyError(ValueError):
    """A study cannot be done as asked."""


class InvalidStudy(StudyError):
    """A setting of a study is unknown or out of its range."""


class ReplayError(StudyError):
    """A recorded replay cannot be used."""


class ReplayNotFound(ReplayError):
    """There is no replay in this folder."""

    def __init__(self, folder: Path) -> None:
        super().__init__(f"{folder} holds no replay; `mapt dataset` records one")


class NoTrueRewards(ReplayError):
    """A replay cannot be judged by scripted teachers: its segments were kept without their true rewards."""

    def __init__(self, folder: Path) -> None:
        super().__init__(f"The segments in {folder} were kept without true rewards, by which scripted teachers judge")


class DamagedCell(StudyError):
    """A finished cell of a table cannot be read back."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"The cell {path} cannot be read ({reason}); delete it to have it made again")


class RecordingStopped(StudyError):
    """A replay was not recorded whole; its folder is as if it had not been begun."""

    def __init__(self, folder: Path) -> None:
        super().__init__(f"The recording in {folder} was stopped, and nothing of it kept")


class TooFewLabels(StudyError):
    """A teacher skips so often that it will not reach the labels asked of it."""

    def __init__(self, teacher: str, labels: int, given: int) -> None:
        super().__init__(f"The teacher {teacher} gave {given} of {labels} labels and skipped every other pair")
