"""A task that cannot be made, as football without its engine, as a task file (see docs/how-to/task.md)."""

from typing import Any, Never

from mapt.errors import UnusableEnvironment
from mapt.tasks import MujocoDefinition, register_task
from mapt.tasks.registry import find_definition

NAME, REASON = "UnusableHalfCheetah-2x3", "The engine of this task is not installed."
FILE = __file__


class Unusable(MujocoDefinition):
    def make(self, *_arguments: Any, **_options: Any) -> Never:
        raise UnusableEnvironment(REASON)


if __name__ == "unusable_task":  # run as a task file
    found = find_definition("HalfCheetah-2x3")
    assert isinstance(found, MujocoDefinition)
    register_task(Unusable(NAME, found.robot, found.mdp, found.agent_names, found.instructions))
