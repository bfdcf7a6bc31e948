from collections.abc import Iterator
from pathlib import Path

import pytest

from integration.workers.worker_harness import WorkerHarness, open_harness


@pytest.fixture(autouse=True)
def use_short_episodes(short_episodes: None) -> None:
    """Shorten the episodes in every test of this folder, since runs play whole episodes."""


@pytest.fixture
def harness(tmp_path: Path) -> Iterator[WorkerHarness]:
    with open_harness(tmp_path) as opened:
        yield opened
