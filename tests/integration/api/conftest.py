from collections.abc import Generator
from pathlib import Path

import pytest

from support.api_in_thread import Served, served
from support.store_fixtures import both, postgres_server, sqlite
from support.stores import Stores

__all__ = ["api", "both", "both_api", "postgres_server", "sqlite"]


@pytest.fixture
def api(sqlite: Stores, tmp_path: Path) -> Generator[Served]:
    """The API over SQLite."""
    with served(sqlite, tmp_path) as made:
        yield made


@pytest.fixture
def both_api(both: Stores, tmp_path: Path) -> Generator[Served]:
    """The API over SQLite, and then over Postgres."""
    with served(both, tmp_path) as made:
        yield made
