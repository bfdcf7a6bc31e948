"""A real service per test: its supervisor and all its processes, on a free port, over a fresh home."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from acceptance.accord_service import Accord


@pytest.fixture
def accord(tmp_path: Path) -> Iterator[Accord]:
    """Not started yet. Whatever of it still runs at the end is killed."""
    service = Accord(tmp_path / "home")
    yield service
    service.kill_everything()
