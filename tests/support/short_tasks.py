"""Cheetahs of short episodes, for tests that play whole ones though it is not about them.

A file of tasks, as docs/tasks.md has it: named in MAPT_TASKS, it is known to every process of a service. A test that
imports it for its names registers nothing: tests that are collected for every task there is must not find these.
"""

from dataclasses import replace

import pytest

from mapt.tasks import MujocoDefinition, register_task
from mapt.tasks.registry import TASK_FILES_VARIABLE, find_definition

#: HalfCheetah-6x1 with episodes a twentieth as long
NAME = "ShortHalfCheetah-6x1"
HORIZON_STEPS = 50
#: HalfCheetah-2x3 with episodes a fiftieth as long
SHORTEST_NAME = "ShortestHalfCheetah-2x3"
SHORTEST_HORIZON_STEPS = 20
ENVIRONMENT = {TASK_FILES_VARIABLE: __file__}


@pytest.fixture
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets this process and those it starts know the tasks with short episodes."""
    monkeypatch.setenv(TASK_FILES_VARIABLE, __file__)


def _register(whole: str, name: str, horizon_steps: int) -> None:
    definition = find_definition(whole)
    assert isinstance(definition, MujocoDefinition)
    register_task(replace(definition, name=name, horizon_steps=horizon_steps))


if __name__ == "short_tasks":  # run as a file of tasks
    _register("HalfCheetah-6x1", NAME, HORIZON_STEPS)
    _register("HalfCheetah-2x3", SHORTEST_NAME, SHORTEST_HORIZON_STEPS)
