"""docs/reference.md documents every setting, command and option, docs/client.md every method of the client."""

from pathlib import Path

import pytest

from accord.cli.reference import commands, fill, fill_client, options_of
from accord.settings import Settings

DOCS = Path(__file__).parents[3] / "docs"
REFERENCE, CLIENT = ((DOCS / name).read_text() for name in ("reference.md", "client.md"))
COMMANDS = commands()


def test_the_generated_parts_are_up_to_date() -> None:
    assert fill(REFERENCE) == REFERENCE, "run python -m accord.cli.reference"
    assert fill_client(CLIENT) == CLIENT, "run python -m accord.cli.reference"


def test_every_documented_setting_exists() -> None:
    documented = {word.strip("`") for word in REFERENCE.split() if word.startswith("`ACCORD_")}
    assert documented - {"ACCORD_TOKEN"} <= {f"ACCORD_{name.upper()}" for name in Settings.model_fields}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_and_option_has_a_help_text(command: str) -> None:
    assert COMMANDS[command].help
    assert [option.name for option in options_of(COMMANDS[command]) if not option.help] == []


def test_every_documented_command_exists() -> None:
    headings = {line.removeprefix("### ") for line in REFERENCE.splitlines() if line.startswith("### ")}
    assert {heading for heading in headings if heading.startswith(("accord ", "mapt "))} == set(COMMANDS)
