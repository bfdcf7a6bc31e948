"""An error as one sentence for a person."""

from accord.domain.errors import AccordError

_LONGEST = 400


def sentence(error: BaseException) -> str:
    """The first line of what went wrong; the kind of error too, unless it is one of ours."""
    lines = str(error).strip().splitlines()
    words = lines[0] if lines else ""
    if not isinstance(error, AccordError):
        words = f"{type(error).__name__}: {words}" if words else type(error).__name__
    if words and words[-1] not in ".!?":
        words += "."
    return words if len(words) <= _LONGEST else words[: _LONGEST - 1] + "…"
