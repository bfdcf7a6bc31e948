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
    start = time.monotonic()
    while not (found := condition()):
        waited = time.monotonic() - start
        assert waited < PATIENCE_SECONDS, f"timed out after {PATIENCE_SECONDS:.0f} s: {what}"
        # A condition can cost as much as what it waits for, such as a request to a server: after a second or more,
        # check it a few times a second.
        time.sleep(min(0.01 + waited / 20, 0.2))
    return found
