"""What is written on a command line: settings as KEY=VALUE, lists with commas, and models and teachers as NAME, or
NAME:setting=value:setting=value."""

import json
from dataclasses import dataclass

from mapt.errors import InvalidConfig


@dataclass(frozen=True, slots=True)
class Written:
    """A name and the settings in which something differs from what usually has it."""

    name: str
    settings: dict[str, object]

    @classmethod
    def parse(cls, text: str) -> "Written":
        """Read a text such as `MAPT:tpa=false:hidden_dim=128`.

        Raises:
            InvalidConfig: if a part is no setting=value.
        """
        name, *parts = text.strip().split(":")
        settings: dict[str, object] = {}
        for part in parts:
            try:
                key, value = setting(part)
            except InvalidConfig as error:
                raise InvalidConfig(f"{error} in {text!r}; one looks like hidden_dim=128") from error
            settings[key] = value
        return cls(name, settings)


def setting(text: str) -> tuple[str, object]:
    """Key and value of KEY=VALUE: a number, true, false, null or a list as JSON writes them, or else a word.

    Raises:
        InvalidConfig: if it is none.
    """
    name, equals, value = text.strip().partition("=")
    if not name or not equals:
        raise InvalidConfig(f"{text!r} is no KEY=VALUE")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def words(option: str, text: str) -> tuple[str, ...]:
    """The parts of a list with commas.

    Raises:
        InvalidConfig: if one is empty or comes twice.
    """
    parts = tuple(part.strip() for part in text.split(","))
    if not all(parts) or len(set(parts)) != len(parts):
        raise InvalidConfig(f"{option} {text!r} must name at least one, each once, with commas between")
    return parts


def numbers(option: str, text: str, least: int) -> tuple[int, ...]:
    """The whole numbers of a list with commas.

    Raises:
        InvalidConfig: if one is no number, too small, or comes twice.
    """
    try:
        parts = tuple(int(part) for part in words(option, text))
    except ValueError as error:
        raise InvalidConfig(f"{option} {text!r} is no list of numbers; it looks like 0,1,2") from error
    if min(parts) < least or len(set(parts)) != len(parts):
        raise InvalidConfig(f"{option} {text!r}: each must be {least} or more, and come once")
    return parts
