"""`accord link` and `accord user`, each test with its own database."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from accord.cli.main import main
from accord.services import accounts
from accord.store.database import Database

Accord = Callable[..., "Result"]


class Result(NamedTuple):
    """Exit status and output of a command."""

    status: int
    lines: list[str]
    errors: str


@pytest.fixture
def accord(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Accord:
    """A function that runs a command in this process, with a fresh home folder."""
    monkeypatch.setenv("ACCORD_HOME", str(tmp_path))

    def run(*arguments: str) -> Result:
        monkeypatch.setattr(sys, "argv", ["accord", *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
        printed = capsys.readouterr()
        return Result(int(caught.value.code or 0), printed.out.splitlines(), printed.err)

    return run


def user_of_link(link: str, home: Path) -> tuple[str, str]:
    """Redeem a sign-in link; return the name and role of its user."""
    database = Database.open(f"sqlite:///{home / 'accord.db'}")
    with database.transaction() as session:
        user, _ = accounts.redeem_link(session, link.rpartition("/")[2], 30)
        name_and_role = (user.name, user.role)
    database.close()
    return name_and_role


def test_a_link_without_a_name_signs_in_the_admin(accord: Accord, tmp_path: Path) -> None:
    [link] = accord("link").lines
    assert user_of_link(link, tmp_path) == ("admin", "admin")


def test_a_link_for_a_user_signs_in_that_user(accord: Accord, tmp_path: Path) -> None:
    assert accord("user", "add", "Lena").status == 0
    [link] = accord("user", "link", "Lena").lines
    assert user_of_link(link, tmp_path) == ("Lena", "labeller")


def test_adding_an_existing_user_suggests_the_link_command(accord: Accord) -> None:
    accord("user", "add", "Lena Maier")
    ended = accord("user", "add", "Lena Maier")
    assert ended.status == 2
    assert "accord user link 'Lena Maier'" in ended.errors


def test_users_are_listed_in_columns(accord: Accord) -> None:
    accord("user", "add", "Lena Maier")
    accord("user", "add", "bot", "--role", "teacher")
    heading, *rows = accord("user", "list").lines
    assert heading.split() == ["user", "role", "labels", "browsers", "tokens", "added", "last", "seen"]
    # "never" seen; the date before it is today's
    assert [[*row.split()[:-2], row.split()[-1]] for row in rows] == [
        ["Lena", "Maier", "labeller", "0", "0", "1", "never"],
        ["bot", "teacher", "0", "0", "1", "never"],
    ]


def test_users_are_listed_as_json(accord: Accord) -> None:
    accord("user", "add", "bot", "--role", "teacher")
    [user] = json.loads("".join(accord("user", "list", "--json").lines))
    assert (user["name"], user["role"], user["tokens"]) == ("bot", "teacher", 1)


def test_a_removed_user_is_not_listed(accord: Accord) -> None:
    accord("user", "add", "Lena")
    assert accord("user", "remove", "Lena").status == 0
    assert len(accord("user", "list").lines) == 1
    assert accord("user", "link", "Lena").status == 2


@pytest.mark.parametrize("command", ["link", "remove"])
def test_an_unknown_user_is_named_in_the_error(accord: Accord, command: str) -> None:
    ended = accord("user", command, "Nobody")
    assert ended.status == 2
    assert "'Nobody'" in ended.errors
