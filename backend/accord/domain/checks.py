"""What `accord doctor` and the start of `accord up` find out about a machine."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Check:
    """One finding."""

    #: what was looked at, in two or three words
    name: str
    ok: bool
    #: what was found: a version, a path, the error's own words
    detail: str
    #: what to do about it; None where all is well
    fix: str | None = None
