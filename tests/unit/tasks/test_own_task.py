"""docs/tasks.md's own task works as it stands there."""

import re
from pathlib import Path

import numpy as np
import pytest

from mapt.tasks import TaskFileFailed, UnknownTask, agent_geoms, make_task, task_names, task_spec

DOCUMENT = Path(__file__).parents[3] / "docs" / "tasks.md"
FIRST_BLOCK = re.search(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)


def test_the_documented_file_is_a_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert FIRST_BLOCK is not None
    with pytest.raises(UnknownTask):
        task_spec("Tug-2x1")
    file = tmp_path / "tug.py"
    file.write_text(FIRST_BLOCK[1])
    monkeypatch.setenv("MAPT_TASKS", str(file))
    assert "Tug-2x1" in task_names()
    task = make_task("Tug-2x1", 4, n_threads=1)
    observations, _ = task.reset(0)
    assert observations.shape == (4, 2, 5)
    assert [len(geoms) for geoms in agent_geoms("Tug-2x1")] == [1, 1]
    push = np.ones((4, 2, 1))
    steps = [task.step(push) for _ in range(200)]
    assert (steps[10].reward > steps[0].reward).all()
    assert steps[-1].truncated.all()


def test_a_file_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAPT_TASKS", "no/such_file.py")
    with pytest.raises(TaskFileFailed, match=r"no/such_file.py"):
        task_names()
