"""The examples of docs/how-to/task.md work."""

import re
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from mapt.errors import TaskImportFailed, UnknownTask
from mapt.tasks import RenderableTask, agent_geoms, make_task, task_names, task_spec
from support import light_tasks

DOCUMENT = Path(__file__).parents[3] / "docs" / "how-to" / "task.md"
MUJOCO_BLOCK, PETTINGZOO_BLOCK = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)


def test_documented_mujoco_task_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnknownTask):
        task_spec("Tug-2x1")
    file = tmp_path / "tug.py"
    file.write_text(MUJOCO_BLOCK)
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


def test_documented_pettingzoo_task_works_and_renders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    render_modes: list[str] = []

    def parallel_env(render_mode: str) -> light_tasks.Buttons:
        render_modes.append(render_mode)
        return light_tasks.Buttons()

    game = ModuleType("my_game")
    game.__dict__["parallel_env"] = parallel_env
    monkeypatch.setitem(sys.modules, "my_game", game)
    file = tmp_path / "my_tasks.py"
    file.write_text(PETTINGZOO_BLOCK)
    monkeypatch.setenv("MAPT_TASKS", str(file))
    assert task_spec("MyGame-2").instructions == "What the team should achieve."
    task = make_task("MyGame-2", 2)
    task.reset(0)
    steps = [task.step(np.tile([0.0, 1.0], (2, 2, 1))) for _ in range(100)]
    assert steps[-1].truncated.all()
    assert isinstance(task, RenderableTask)
    assert task.render(1).shape == (*light_tasks.IMAGE_SIZE, 3)
    assert set(render_modes) == {"rgb_array"}


def test_error_of_a_missing_task_file_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAPT_TASKS", "no/such_file.py")
    with pytest.raises(TaskImportFailed) as error:
        task_names()
    assert error.value.name == "no/such_file.py"


def test_threads_wait_for_the_import_of_a_task_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "slow_tasks.py"
    slow = MUJOCO_BLOCK.replace("Tug-2x1", "SlowTug-2x1")
    file.write_text("import time\ntime.sleep(0.5)\n" + slow)
    monkeypatch.setenv("MAPT_TASKS", str(file))
    with ThreadPoolExecutor(4) as threads:
        specs = list(threads.map(lambda _: task_spec("SlowTug-2x1"), range(4)))
    assert [spec.name for spec in specs] == ["SlowTug-2x1"] * 4
