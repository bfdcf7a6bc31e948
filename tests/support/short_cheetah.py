"""HalfCheetah-6x1 with episodes a twentieth as long, for tests that play whole ones though it is not about them.

A file of tasks, as docs/tasks.md has it: named in MAPT_TASKS, it is known to every process of a service.
"""

from dataclasses import replace

from mapt.tasks import MujocoEntry, register_task
from mapt.tasks.registry import find_entry

NAME = "ShortHalfCheetah-6x1"
ENVIRONMENT = {"MAPT_TASKS": __file__}

if __name__ == "short_cheetah":
    # Run as a file of tasks; a test that imports this module for its names registers nothing.
    whole = find_entry("HalfCheetah-6x1")
    assert isinstance(whole, MujocoEntry)
    register_task(replace(whole, name=NAME, horizon_steps=50))
