"""Fixtures for stores; a conftest.py re-exports those that its tests use."""

import secrets
from collections.abc import Generator
from pathlib import Path

import pytest

from support.ci import IN_CI
from support.s3_server import S3Server
from support.stores import PostgresServer, Stores, migrated_postgres_database, missing_for_postgres, open_stores


@pytest.fixture(scope="session")
def postgres_server() -> Generator[PostgresServer]:
    """A PostgreSQL server, started once per test process.

    Without PostgreSQL, tests skip and say what is missing; in CI (`CI=true`) they fail.
    """
    missing = missing_for_postgres()
    if missing and IN_CI:
        pytest.fail(missing)
    if missing:
        pytest.skip(missing)
    with PostgresServer() as server:
        yield server


@pytest.fixture(scope="session")
def s3_server(tmp_path_factory: pytest.TempPathFactory) -> Generator[S3Server]:
    """An S3 server, started once per test process, whose variables are in the environment of all tests."""
    with S3Server(tmp_path_factory.mktemp("s3")) as server, pytest.MonkeyPatch.context() as patch:
        for name, value in server.environment.items():
            patch.setenv(name, value)
        yield server


@pytest.fixture(params=["sqlite", "postgres"])
def stores(request: pytest.FixtureRequest, tmp_path: Path) -> Generator[Stores]:
    """Stores on one machine, and on servers: the test runs with SQLite and a folder, and with PostgreSQL and S3."""
    if request.param == "sqlite":
        with open_stores(tmp_path) as opened:
            yield opened
        return
    server: PostgresServer = request.getfixturevalue("postgres_server")
    objects: S3Server = request.getfixturevalue("s3_server")
    name = f"test_{secrets.token_hex(6)}"
    with (
        migrated_postgres_database(server.url, name) as url,
        open_stores(tmp_path, url, objects.url(name)) as opened,
    ):
        yield opened


@pytest.fixture
def sqlite(tmp_path: Path) -> Generator[Stores]:
    """Stores on SQLite only."""
    with open_stores(tmp_path) as opened:
        yield opened
