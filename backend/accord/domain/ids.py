"""Identifiers: a prefix that says of what, then 24 hexadecimal digits that sort by time of making."""

import re
import secrets
import time

from accord.domain.errors import InvalidId

_PATTERN = re.compile(r"[0-9a-f]{24}")


def new_id(prefix: str) -> str:
    """A new identifier: 11 digits of milliseconds since 1970, then 13 random ones (52 bits)."""
    return f"{prefix}_{time.time_ns() // 1_000_000:011x}{secrets.randbits(52):013x}"


def check_id(id: str, prefix: str) -> str:
    """Returns `id`.

    Raises:
        InvalidId: if it is not `prefix`, an underscore and 24 hexadecimal digits.
    """
    head, _, tail = id.partition("_")
    if head != prefix or not _PATTERN.fullmatch(tail):
        raise InvalidId(id, prefix)
    return id
