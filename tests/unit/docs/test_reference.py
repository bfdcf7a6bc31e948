"""docs/reference.md names every setting, command and option."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from accord.cli.main import app
from accord.settings import Settings

REFERENCE = (Path(__file__).parents[3] / "docs" / "reference.md").read_text()


def commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    """(path, command) of every leaf. typer carries its own copy of click, so there is no public type to ask for."""
    inner = getattr(command, "commands", None)
    if inner is None:
        yield path, command
        return
    for name, child in inner.items():
        yield from commands(child, f"{path} {name}")


COMMANDS = dict(commands(typer.main.get_command(app), "accord"))


def section(command: str) -> str:
    return REFERENCE.partition(f"### {command}\n")[2].partition("\n### ")[0].partition("\n## ")[0]


@pytest.mark.parametrize("name", Settings.model_fields)
def test_every_setting_is_documented_with_its_description(name: str) -> None:
    field = Settings.model_fields[name]
    assert f"`ACCORD_{name.upper()}`" in REFERENCE
    assert field.description
    assert field.description in REFERENCE


@pytest.mark.parametrize("path", COMMANDS)
def test_every_command_has_a_section_and_says_what_it_does(path: str) -> None:
    assert section(path)
    assert COMMANDS[path].help


@pytest.mark.parametrize("path", COMMANDS)
def test_every_option_is_in_its_commands_section(path: str) -> None:
    for parameter in COMMANDS[path].params:
        if parameter.param_type_name == "option" and not getattr(parameter, "hidden", False):
            for option in (*parameter.opts, *parameter.secondary_opts):
                assert f"`{option}`" in section(path), f"{path} {option} is missing from docs/reference.md"


def test_no_setting_is_documented_that_is_not_there() -> None:
    documented = {word.strip("`") for word in REFERENCE.split() if word.startswith("`ACCORD_")}
    assert documented - {"ACCORD_TOKEN"} <= {f"ACCORD_{name.upper()}" for name in Settings.model_fields}
