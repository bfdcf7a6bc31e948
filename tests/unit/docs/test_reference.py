"""docs/reference.md names every setting, command and option, and none that is not there."""

from typing import Any

import pytest

from accord.cli.main import app as accord
from accord.cli.reference import fill
from accord.settings import Settings
from mapt.cli.main import app as mapt
from support.reference import REFERENCE, commands_of, options_of, section

COMMANDS: dict[str, Any] = commands_of(accord, "accord") | commands_of(mapt, "mapt")


def test_the_generated_parts_are_up_to_date() -> None:
    assert fill(REFERENCE) == REFERENCE, "run python -m accord.cli.reference"


def test_no_setting_is_documented_that_is_not_there() -> None:
    documented = {word.strip("`") for word in REFERENCE.split() if word.startswith("`ACCORD_")}
    assert documented - {"ACCORD_TOKEN"} <= {f"ACCORD_{name.upper()}" for name in Settings.model_fields}


@pytest.mark.parametrize("path", COMMANDS)
def test_every_command_has_a_section_and_says_what_it_does(path: str) -> None:
    assert section(path), f"docs/reference.md has no section ### {path}"
    assert COMMANDS[path].help


@pytest.mark.parametrize("path", COMMANDS)
def test_every_option_says_what_it_is_for_and_is_in_its_commands_section(path: str) -> None:
    for option in options_of(COMMANDS[path]):
        assert option.help, f"{path} {option.name} says nothing"
        for name in (*option.opts, *option.secondary_opts):
            assert f"`{name}`" in section(path), f"{path} {name} is missing from docs/reference.md"


@pytest.mark.parametrize("path", COMMANDS)
def test_no_option_is_documented_that_is_not_there(path: str) -> None:
    rows = [line for line in section(path).splitlines() if line.startswith("| `--")]
    documented = {word.strip("`,") for row in rows for word in row.split("|")[1].split() if "--" in word}
    there = {name for option in COMMANDS[path].params for name in (*option.opts, *option.secondary_opts)}
    assert documented <= there


def test_every_documented_command_is_there() -> None:
    headings = {line.removeprefix("### ") for line in REFERENCE.splitlines() if line.startswith("### ")}
    assert {heading for heading in headings if heading.startswith(("accord ", "mapt "))} == set(COMMANDS)
