"""docs/reference.md, and the commands that it must name."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

REFERENCE = (Path(__file__).parents[2] / "docs" / "reference.md").read_text()


def commands_of(app: typer.Typer, name: str) -> dict[str, Any]:
    """Every command of an application by its words, such as `accord user add`."""
    return dict(_leaves(typer.main.get_command(app), name))


def _leaves(command: Any, words: str) -> Iterator[tuple[str, Any]]:
    # typer carries its own copy of click, so there is no public type to ask for.
    inner = getattr(command, "commands", None)
    if inner is None:
        yield words, command
        return
    for name, child in inner.items():
        yield from _leaves(child, f"{words} {name}")


def section(command: str) -> str:
    """What the reference says of a command; empty if it names none such."""
    return REFERENCE.partition(f"### {command}\n")[2].partition("\n### ")[0].partition("\n## ")[0]


def options_of(command: Any) -> Iterator[Any]:
    """Its options, but for those that help does not show."""
    for parameter in command.params:
        if parameter.param_type_name == "option" and not getattr(parameter, "hidden", False):
            yield parameter
