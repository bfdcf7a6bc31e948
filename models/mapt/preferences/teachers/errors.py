"""What can be wrong with a teacher.

PreferenceError
├── EvidenceMissing
└── InvalidTeacher
    └── UnknownTeacher
"""

from collections.abc import Sequence

from mapt.preferences.errors import PreferenceError


class EvidenceMissing(PreferenceError):
    """A rule needs to see something that it was not shown."""

    def __init__(self, what: str) -> None:
        super().__init__(f"this teacher judges by {what}, which the segments do not have")


class InvalidTeacher(PreferenceError):
    """A teacher cannot have this parameter, or not with this value."""


class UnknownTeacher(InvalidTeacher):
    """No teacher has this name."""

    def __init__(self, name: str, known: Sequence[str]) -> None:
        super().__init__(f"no teacher is called {name!r}; there are {', '.join(known)}, and 'rule+preset' of them")
