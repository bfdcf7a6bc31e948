"""The result of a check by `accord doctor`."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Check:
    """Whether one thing works on this machine, and what to do if it does not."""

    #: what was checked, in a few words
    name: str
    ok: bool
    #: what was found: a version, a path or an error message
    detail: str
    #: how to fix it; None if the check passed
    fix: str | None = None
