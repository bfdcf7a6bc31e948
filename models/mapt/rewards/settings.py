"""Reading and checking settings."""

from collections.abc import Callable, Mapping
from typing import TypeVar

from mapt.rewards.errors import InvalidConfig

SettingsT = TypeVar("SettingsT")


def read_settings(build: Callable[..., SettingsT], known: set[str], values: Mapping[str, object]) -> SettingsT:
    unknown = sorted(set(values) - known)
    if unknown:
        raise InvalidConfig(f"unknown setting {unknown[0]!r}; known: {', '.join(sorted(known))}")
    try:
        return build(**values)
    except TypeError as error:
        raise InvalidConfig(str(error)) from error


def check_positive_int(name: str, value: object) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise InvalidConfig(f"{name} is {value!r}; it must be a whole number, 1 or more")


def check_range(name: str, value: object, low: float, high: float) -> None:
    if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        raise InvalidConfig(f"{name} is {value!r}; it must lie in [{low}, {high}]")
