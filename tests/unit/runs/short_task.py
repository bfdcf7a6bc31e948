"""A cheetah of short episodes, for a process that is told of it by MAPT_TASKS, or imports this."""

from dataclasses import replace

from mapt.tasks import MujocoEntry, register_task, task_names
from mapt.tasks.registry import find_entry

NAME = "ShortCheetah-2x3"
HORIZON_STEPS = 20

if NAME not in task_names():
    entry = find_entry("HalfCheetah-2x3")
    assert isinstance(entry, MujocoEntry)
    register_task(replace(entry, name=NAME, horizon_steps=HORIZON_STEPS))
