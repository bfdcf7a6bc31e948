"""Identifiers: a prefix for the kind of object and 24 hexadecimal digits, which sort by time of creation."""

import re
import secrets
import threading
import time

from accord.domain.errors import InvalidId

_PATTERN = re.compile(r"[0-9a-f]{24}")


class _Clock:
    """Increasing numbers: milliseconds since 1970, then 52 random bits."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last = 0

    def tick(self) -> int:
        new = (time.time_ns() // 1_000_000) << 52 | secrets.randbits(52)
        with self._lock:
            # Rows created within one millisecond keep their order, on which seeded choices depend.
            self._last = max(new, self._last + 1)
            return self._last


_clock = _Clock()


def new_id(prefix: str) -> str:
    """A new identifier; it sorts after all identifiers that this process created before it."""
    return f"{prefix}_{_clock.tick():024x}"


def check_id(id: str, prefix: str) -> str:
    """Returns `id`.

    Raises:
        InvalidId: if it is not `prefix`, an underscore and 24 hexadecimal digits.
    """
    head, _, tail = id.partition("_")
    if head != prefix or not _PATTERN.fullmatch(tail):
        raise InvalidId(id, prefix)
    return id
