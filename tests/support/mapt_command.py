"""The mapt command, run in the test process."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from mapt.cli.main import main


class CommandResult(NamedTuple):
    """Exit status and output of a command."""

    status: int
    printed: str
    errors: str


@pytest.fixture
def mapt(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., CommandResult]:
    """Run the command in this process."""

    def run(*arguments: str | Path) -> CommandResult:
        return CommandResult(run_mapt(monkeypatch, *arguments), *capsys.readouterr())

    return run


def run_mapt(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    """Run the command in this process; return its exit status."""
    monkeypatch.setattr(sys, "argv", ["mapt", *map(str, arguments)])
    with pytest.raises(SystemExit) as exited:
        main()
    return int(exited.value.code or 0)
