from collections.abc import Generator
from pathlib import Path

import pytest

from support.api_in_thread import ApiServer, run_api_server
from support.store_fixtures import postgres_server, s3_server, sqlite, stores
from support.stores import Stores

__all__ = ["api", "api_per_database", "postgres_server", "s3_server", "sqlite", "stores"]


@pytest.fixture
def api(sqlite: Stores, tmp_path: Path) -> Generator[ApiServer]:
    """The API on SQLite only."""
    with run_api_server(sqlite, tmp_path) as server:
        yield server


@pytest.fixture
def api_per_database(stores: Stores, tmp_path: Path) -> Generator[ApiServer]:
    """The API on SQLite and on PostgreSQL: the test runs once with each."""
    with run_api_server(stores, tmp_path) as server:
        yield server
