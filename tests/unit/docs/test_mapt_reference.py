"""docs/reference.md names every command and option of mapt."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from mapt.cli.main import app

REFERENCE = (Path(__file__).parents[3] / "docs" / "reference.md").read_text()


def commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    """(path, command) of every leaf."""
    inner = getattr(command, "commands", None)
    if inner is None:
        yield path, command
        return
    for name, child in inner.items():
        yield from commands(child, f"{path} {name}")


COMMANDS = dict(commands(typer.main.get_command(app), "mapt"))


def section(command: str) -> str:
    return REFERENCE.partition(f"### {command}\n")[2].partition("\n### ")[0].partition("\n## ")[0]


@pytest.mark.parametrize("path", COMMANDS)
def test_every_mapt_command_has_a_section_and_says_what_it_does(path: str) -> None:
    assert section(path), f"docs/reference.md has no section ### {path}"
    assert COMMANDS[path].help


@pytest.mark.parametrize("path", COMMANDS)
def test_every_mapt_option_is_in_its_commands_section(path: str) -> None:
    for parameter in COMMANDS[path].params:
        if parameter.param_type_name == "option" and not getattr(parameter, "hidden", False):
            assert parameter.help, f"{path} {parameter.name} says nothing"
            for option in (*parameter.opts, *parameter.secondary_opts):
                assert f"`{option}`" in section(path), f"{path} {option} is missing from docs/reference.md"


def test_no_mapt_option_is_documented_that_is_not_there() -> None:
    for path, command in COMMANDS.items():
        rows = [line for line in section(path).splitlines() if line.startswith("| `--")]
        documented = {word.strip("`,") for row in rows for word in row.split("|")[1].split()}
        there = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        assert documented <= there


def test_every_documented_mapt_command_is_there() -> None:
    headings = {line.removeprefix("### ") for line in REFERENCE.splitlines() if line.startswith("### mapt ")}
    assert headings == set(COMMANDS)
