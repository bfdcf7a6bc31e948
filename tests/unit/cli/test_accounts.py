"""`accord link` and `accord user`, over a database of their own."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from accord.cli.main import main
from accord.services import accounts
from accord.store.database import Database

Accord = Callable[..., "Ended"]


class Ended(NamedTuple):
    """How a command ended."""

    status: int
    lines: list[str]
    errors: str


@pytest.fixture
def accord(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Accord:
    """Runs the command in this process, in a home of its own."""
    monkeypatch.setenv("ACCORD_HOME", str(tmp_path))

    def run(*arguments: str) -> Ended:
        monkeypatch.setattr(sys, "argv", ["accord", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        printed = capsys.readouterr()
        return Ended(int(ended.value.code or 0), printed.out.splitlines(), printed.err)

    return run


def signed_in_by(link: str, home: Path) -> tuple[str, str]:
    """Name and role of the user whom a sign-in link signs in."""
    database = Database.open(f"sqlite:///{home / 'accord.db'}")
    with database.transaction() as session:
        user, _ = accounts.redeem_link(session, link.rpartition("/")[2], 30)
        found = (user.name, user.role)
    database.close()
    return found


def test_a_link_without_a_name_is_the_admins(accord: Accord, tmp_path: Path) -> None:
    [link] = accord("link").lines
    assert signed_in_by(link, tmp_path) == ("admin", "admin")


def test_a_link_for_a_user_signs_in_that_user_with_their_role(accord: Accord, tmp_path: Path) -> None:
    assert accord("user", "add", "Lena").status == 0
    [link] = accord("user", "link", "Lena").lines
    assert signed_in_by(link, tmp_path) == ("Lena", "labeller")


def test_adding_a_user_who_exists_names_the_command_for_a_link(accord: Accord) -> None:
    accord("user", "add", "Lena Maier")
    ended = accord("user", "add", "Lena Maier")
    assert ended.status == 2
    assert "accord user link 'Lena Maier'" in ended.errors


def test_users_are_listed_in_columns(accord: Accord) -> None:
    accord("user", "add", "Lena Maier")
    accord("user", "add", "bot", "--role", "teacher")
    heading, *rows = accord("user", "list").lines
    assert heading.split() == ["user", "role", "labels", "browsers", "tokens", "added"]
    assert [row.split()[:-1] for row in rows] == [
        ["Lena", "Maier", "labeller", "0", "0", "1"],
        ["bot", "teacher", "0", "0", "1"],
    ]


def test_users_are_listed_as_json(accord: Accord) -> None:
    accord("user", "add", "bot", "--role", "teacher")
    [user] = json.loads("".join(accord("user", "list", "--json").lines))
    assert (user["name"], user["role"], user["tokens"]) == ("bot", "teacher", 1)


def test_a_removed_user_is_gone_from_the_list(accord: Accord) -> None:
    accord("user", "add", "Lena")
    assert accord("user", "remove", "Lena").status == 0
    assert len(accord("user", "list").lines) == 1
    assert accord("user", "link", "Lena").status == 2


@pytest.mark.parametrize("command", ["link", "remove"])
def test_a_user_who_does_not_exist_is_named(accord: Accord, command: str) -> None:
    ended = accord("user", command, "Nobody")
    assert ended.status == 2
    assert "'Nobody'" in ended.errors
