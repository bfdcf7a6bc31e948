from collections.abc import Iterator
from pathlib import Path

import pytest

from integration.workers.workplace import Workplace, workplace
from support import short_cheetah


@pytest.fixture(autouse=True)
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets this process and those it starts know the task with short episodes."""
    for name, value in short_cheetah.ENVIRONMENT.items():
        monkeypatch.setenv(name, value)


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Workplace]:
    with workplace(tmp_path) as made:
        yield made
