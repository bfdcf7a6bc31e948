"""pytest fixtures over `support.stores`; a conftest.py imports those that its tests use."""

import secrets
from collections.abc import Generator
from pathlib import Path

import pytest

from support.stores import Stores, empty_postgres_database, missing_for_postgres, postgres, stores


@pytest.fixture(scope="session")
def postgres_server() -> Generator[str]:
    """The URL of a Postgres server, one for the whole run."""
    missing = missing_for_postgres()
    if missing:
        pytest.skip(missing)
    with postgres() as url:
        yield url


@pytest.fixture(params=["sqlite", "postgres"])
def both(request: pytest.FixtureRequest, tmp_path: Path) -> Generator[Stores]:
    """Stores on SQLite, and then on Postgres."""
    if request.param == "sqlite":
        with stores(tmp_path) as made:
            yield made
        return
    server: str = request.getfixturevalue("postgres_server")
    with empty_postgres_database(server, f"test_{secrets.token_hex(6)}") as url, stores(tmp_path, url) as made:
        yield made


@pytest.fixture
def sqlite(tmp_path: Path) -> Generator[Stores]:
    """Stores on SQLite alone."""
    with stores(tmp_path) as made:
        yield made
