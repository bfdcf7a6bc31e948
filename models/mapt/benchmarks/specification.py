"""Parse comma-separated lists, and names with settings: NAME:KEY=VALUE:KEY=VALUE."""

from dataclasses import dataclass

from mapt.errors import InvalidConfig
from mapt.settings import parse_assignments


@dataclass(frozen=True, slots=True)
class NamedSettings:
    """A name and the settings that it overrides, such as `MAPT:tpa=false:hidden_dim=128`."""

    name: str
    settings: dict[str, object]

    @classmethod
    def parse(cls, text: str) -> "NamedSettings":
        """Parse NAME:KEY=VALUE:KEY=VALUE.

        Raises:
            InvalidConfig: if a part after the name is not KEY=VALUE.
        """
        name, *parts = text.strip().split(":")
        return cls(name, parse_assignments(parts))


def parse_list(option: str, text: str) -> tuple[str, ...]:
    """The parts of a comma-separated list.

    Raises:
        InvalidConfig: if a part is empty or repeated.
    """
    parts = tuple(part.strip() for part in text.split(","))
    if not all(parts) or len(set(parts)) != len(parts):
        raise InvalidConfig(f"{option} {text!r} must be a comma-separated list without empty or repeated values.")
    return parts


def parse_numbers(option: str, text: str, minimum: int) -> tuple[int, ...]:
    """The integers of a comma-separated list.

    Raises:
        InvalidConfig: if a part is not an integer, is less than `minimum` or is repeated.
    """
    try:
        parts = tuple(int(part) for part in parse_list(option, text))
    except ValueError as error:
        raise InvalidConfig(f"{option} {text!r} must be a comma-separated list of integers, such as 0,1,2.") from error
    if min(parts) < minimum or len(set(parts)) != len(parts):
        raise InvalidConfig(f"{option} {text!r}: each value must be {minimum} or more, without repeats.")
    return parts
