"""Waiting for what other processes and threads do."""

import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")

#: What is waited for happens within seconds, or never. A machine that does ten other things takes ten times as long,
#: and that is no failure. Below the limit of a whole test, pytest's `timeout`.
PATIENCE_SECONDS = 300.0


def until(condition: Callable[[], Found | None], what: str = "what is waited for") -> Found:
    """The condition's value once it is true.

    Args:
        what: what should happen, for the failure's message.
    """
    deadline = time.monotonic() + PATIENCE_SECONDS
    while not (found := condition()):
        assert time.monotonic() < deadline, f"not in {PATIENCE_SECONDS:.0f} s: {what}"
        time.sleep(0.01)
    return found
