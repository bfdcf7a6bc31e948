"""A cheetah of short episodes, for a process that is told of it by MAPT_TASKS, or asks for `known_task`.

To import it registers nothing: tests that are collected for every task there is must not find this one.
"""

from dataclasses import replace

import pytest

from mapt.tasks import MujocoEntry, register_task, task_names
from mapt.tasks.registry import find_entry

NAME = "ShortCheetah-2x3"
HORIZON_STEPS = 20


def register() -> None:
    if NAME not in task_names():
        entry = find_entry("HalfCheetah-2x3")
        assert isinstance(entry, MujocoEntry)
        register_task(replace(entry, name=NAME, horizon_steps=HORIZON_STEPS))


@pytest.fixture(autouse=True, scope="session")
def known_task() -> None:
    """Import it into a module or a conftest, and its tests know the task."""
    register()


if __name__ != "unit.runs.short_task":
    register()
