"""A service per test: a supervisor and its processes, with a new home folder and a free port."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from acceptance.accord_service import Accord
from support.store_fixtures import postgres_server, s3_server

__all__ = ["accord", "postgres_server", "s3_server"]


@pytest.fixture
def accord(tmp_path: Path) -> Iterator[Accord]:
    """A service that is not started yet. Its remaining processes are killed at the end of the test."""
    service = Accord(tmp_path / "home")
    yield service
    service.kill_everything()
