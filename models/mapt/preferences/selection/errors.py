"""What can be wrong with a selection.

PreferenceError
├── UnknownSelector
├── InvalidShare
└── MissingView
"""

from collections.abc import Sequence

from mapt.preferences.errors import PreferenceError


class UnknownSelector(PreferenceError):
    """No selector has this name."""

    def __init__(self, name: str, known: Sequence[str]) -> None:
        super().__init__(f"there is no selector {name!r}; the selectors are: {', '.join(known)}")


class InvalidShare(PreferenceError):
    """A share of a batch lies between none of it and all of it."""

    def __init__(self, share: float) -> None:
        super().__init__(f"the control share is {share}; it must lie in [0, 1]")


class MissingView(PreferenceError):
    """A selector was not told what it chooses by."""

    def __init__(self, what: str) -> None:
        super().__init__(f"this selector needs {what} of the segments in its SegmentView")
