"""Fixtures for stores; a conftest.py re-exports those that its tests use."""

import secrets
from collections.abc import Generator
from pathlib import Path

import pytest

from support.ci import IN_CI
from support.stores import Stores, migrated_postgres_database, missing_for_postgres, open_stores, run_postgres


@pytest.fixture(scope="session")
def postgres_server() -> Generator[str]:
    """The URL of a PostgreSQL server, started once per test process.

    Without PostgreSQL, tests skip and say what is missing; in CI (`CI=true`) they fail.
    """
    missing = missing_for_postgres()
    if missing and IN_CI:
        pytest.fail(missing)
    if missing:
        pytest.skip(missing)
    with run_postgres() as url:
        yield url


@pytest.fixture(params=["sqlite", "postgres"])
def stores(request: pytest.FixtureRequest, tmp_path: Path) -> Generator[Stores]:
    """Stores on SQLite and on PostgreSQL: the test runs once with each."""
    if request.param == "sqlite":
        with open_stores(tmp_path) as opened:
            yield opened
        return
    server: str = request.getfixturevalue("postgres_server")
    with (
        migrated_postgres_database(server, f"test_{secrets.token_hex(6)}") as url,
        open_stores(tmp_path, url) as opened,
    ):
        yield opened


@pytest.fixture
def sqlite(tmp_path: Path) -> Generator[Stores]:
    """Stores on SQLite only."""
    with open_stores(tmp_path) as opened:
        yield opened
