"""Wait for other processes and threads."""

import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")

#: Conditions come true within seconds or never, but a busy machine may take ten times as long. Less than pytest's
#: `timeout` of a whole test.
PATIENCE_SECONDS = 300.0


def until(condition: Callable[[], Found | None], what: str = "the condition") -> Found:
    """Poll a condition until its value is true, and return the value.

    Args:
        what: what should happen, for the error message.
    """
    deadline = time.monotonic() + PATIENCE_SECONDS
    while not (found := condition()):
        assert time.monotonic() < deadline, f"timed out after {PATIENCE_SECONDS:.0f} s: {what}"
        time.sleep(0.01)
    return found
