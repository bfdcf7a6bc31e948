"""HalfCheetah tasks with short episodes, for tests that need complete episodes.

This is a task file (see docs/how-to/task.md): with MAPT_TASKS, all processes of a service know its tasks. Importing it
registers nothing, because some tests are parametrised over all registered tasks.
"""

from dataclasses import replace

import pytest

from mapt.tasks import MujocoDefinition, register_task
from mapt.tasks.registry import TASK_FILES_VARIABLE, find_definition

#: HalfCheetah-6x1 with a twentieth of the horizon
NAME = "ShortHalfCheetah-6x1"
HORIZON_STEPS = 50
#: HalfCheetah-2x3 with a fiftieth of the horizon
SHORTEST_NAME = "ShortestHalfCheetah-2x3"
SHORTEST_HORIZON_STEPS = 20
ENVIRONMENT = {TASK_FILES_VARIABLE: __file__}


@pytest.fixture
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the tasks with short episodes known to this process and its children."""
    monkeypatch.setenv(TASK_FILES_VARIABLE, __file__)


def _register(whole: str, name: str, horizon_steps: int) -> None:
    definition = find_definition(whole)
    assert isinstance(definition, MujocoDefinition)
    register_task(replace(definition, name=name, horizon_steps=horizon_steps))


if __name__ == "short_tasks":  # run as a task file
    _register("HalfCheetah-6x1", NAME, HORIZON_STEPS)
    _register("HalfCheetah-2x3", SHORTEST_NAME, SHORTEST_HORIZON_STEPS)
