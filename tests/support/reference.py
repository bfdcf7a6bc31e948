"""docs/reference.md and the commands that it must document."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

REFERENCE = (Path(__file__).parents[2] / "docs" / "reference.md").read_text()


def commands_of(app: typer.Typer, name: str) -> dict[str, Any]:
    """Every command of an application by its full name, such as `accord user add`."""
    return dict(_leaves(typer.main.get_command(app), name))


def _leaves(command: Any, words: str) -> Iterator[tuple[str, Any]]:
    # typer vendors click, so there is no public type to check for.
    inner = getattr(command, "commands", None)
    if inner is None:
        yield words, command
        return
    for name, child in inner.items():
        yield from _leaves(child, f"{words} {name}")


def section(command: str) -> str:
    """The reference's section about a command; empty if there is none."""
    return REFERENCE.partition(f"### {command}\n")[2].partition("\n### ")[0].partition("\n## ")[0]


def options_of(command: Any) -> Iterator[Any]:
    """The command's options, without hidden ones."""
    for parameter in command.params:
        if parameter.param_type_name == "option" and not getattr(parameter, "hidden", False):
            yield parameter
