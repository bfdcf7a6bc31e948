from collections.abc import Iterator
from pathlib import Path

import pytest

from integration.workers.workplace import Workplace, workplace


@pytest.fixture(autouse=True)
def every_test_has_short_episodes(short_episodes: None) -> None:
    """Each plays whole episodes."""


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Workplace]:
    with workplace(tmp_path) as made:
        yield made
