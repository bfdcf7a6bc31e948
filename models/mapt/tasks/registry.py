"""Tasks by name."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import os
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from itertools import chain
from pathlib import Path

import mujoco
import numpy as np

from mapt.errors import TaskExists, TaskImportFailed, UnknownTask
from mapt.tasks.protocol import Task, TaskDefinition, TaskSpec
from mapt.tasks.robots import (
    ant,
    coupled_half_cheetah,
    half_cheetah,
    hopper,
    humanoid,
    many_segments,
    pusher,
    reacher,
    swimmer,
    walker2d,
)

#: How many joints away an agent sees when nobody says: gymnasium-robotics' 1, not the paper's 0. A joint that knows
#: its neighbours' angles learned more in every pair of runs. True return on HalfCheetah-6x1 after 300,000 steps of
#: MAPPO, seeds 0 and 1: 5,199 and 4,838 against 4,227 and 1,855 with actors of their own, 1,855 and 1,964 against
#: 1,636 and 1,321 with a shared one.
DEFAULT_AGENT_OBSK = 1

_BODIES = (
    half_cheetah,
    ant,
    hopper,
    walker2d,
    humanoid,
    swimmer,
    reacher,
    pusher,
    coupled_half_cheetah,
    many_segments,
)
_DEFINITIONS: dict[str, TaskDefinition] = {
    definition.name: definition for definition in chain.from_iterable(body.TASKS for body in _BODIES)
}


def register_task(definition: TaskDefinition) -> None:
    """Make a task known by its name to this process. See docs/tasks.md.

    Raises:
        TaskExists: if the name is taken.
    """
    if definition.name in _DEFINITIONS:
        raise TaskExists(definition.name)
    _DEFINITIONS[definition.name] = definition


def task_names() -> tuple[str, ...]:
    """Names of all tasks, sorted. Many-segment bodies come in any size; those of common sizes are listed."""
    load_task_files()
    return tuple(sorted(_DEFINITIONS))


def task_spec(name: str, *, agent_obsk: int | None = DEFAULT_AGENT_OBSK, agent_index: bool = True) -> TaskSpec:
    """What `make_task` with these options would give, without making it.

    Raises:
        UnknownTask: if no task has this name.
        InvalidConfig: if `agent_obsk` is negative.
    """
    return find_definition(name).spec(agent_obsk=agent_obsk, agent_index=agent_index)


def make_task(
    name: str,
    n_envs: int,
    *,
    n_threads: int = 0,
    agent_obsk: int | None = DEFAULT_AGENT_OBSK,
    agent_index: bool = True,
    dtype: type[np.floating] = np.float32,
) -> Task:
    """A batch of environments of the task with this name; reset it before the first step.

    Args:
        n_envs: environments, E.
        n_threads: threads that step them; 0 for one per core.
        agent_obsk: how many edges away an agent sees its neighbours' positions; None for one agent that sees the
            state and drives every joint.
        agent_index: append the agent's one-hot index to its observation.
        dtype: of observations and state.

    Raises:
        UnknownTask: if no task has this name.
        InvalidConfig: if a number is out of its range.
    """
    return find_definition(name).make(
        n_envs, n_threads=n_threads, agent_obsk=agent_obsk, agent_index=agent_index, dtype=dtype
    )


def load_model(task_name: str) -> mujoco.MjModel:
    """The model that the task simulates, compiled anew, for a renderer to alter as it likes.

    Raises:
        UnknownTask: if no task has this name.
        NoSimulator: if the task is not simulated by MuJoCo here.
    """
    return find_definition(task_name).load_model()


def agent_geoms(task_name: str) -> tuple[tuple[int, ...], ...]:
    """Per agent, ids of the geoms it moves directly: what a renderer colours to tell the agents apart.

    Raises:
        UnknownTask: if no task has this name.
        NoSimulator: if the task is not simulated by MuJoCo here.
    """
    return find_definition(task_name).agent_geoms()


def find_definition(name: str) -> TaskDefinition:
    """The definition behind a name.

    Raises:
        UnknownTask: if no task has this name.
    """
    load_task_files()
    definition = _DEFINITIONS.get(name) or many_segments.definition(name)
    if definition is None:
        raise UnknownTask(name, task_names())
    return definition


TASK_FILES_VARIABLE = "MAPT_TASKS"
_loaded: set[str] = set()


def load_task_files() -> None:
    """Run every file or module that MAPT_TASKS names and that has not run yet in this process.

    They stand in it as in PATH: paths of Python files, or names of modules, with colons between (semicolons on
    Windows). Each calls `mapt.tasks.register_task`.

    Raises:
        TaskImportFailed: if one is not there, or fails.
    """
    for name in filter(None, os.environ.get(TASK_FILES_VARIABLE, "").split(os.pathsep)):
        if name not in _loaded:
            _loaded.add(name)
            try:
                _run(name)
            except Exception as error:
                _loaded.discard(name)
                raise TaskImportFailed(TASK_FILES_VARIABLE, name, error) from error


def _run(name: str) -> None:
    path = Path(name)
    if path.suffix != ".py":
        import_module(name)
        return
    spec = spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no Python file")
    spec.loader.exec_module(module_from_spec(spec))


_HEADINGS = ("task", "N", "C", "A", "horizon", "state", "step, s")


def task_listing(agent_obsk: int) -> str:
    """One line per task under a line of headings; an agent that drives less than others shows how much it drives.

    Args:
        agent_obsk: as of `make_task`; observations grow with it.

    Raises:
        TaskImportFailed: if a file that MAPT_TASKS names is not there, or fails.
    """
    rows = [_HEADINGS, *(_row(name, agent_obsk) for name in task_names())]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(_line(row, widths) for row in rows)


def _row(name: str, agent_obsk: int) -> tuple[str, ...]:
    spec = task_spec(name, agent_obsk=agent_obsk)
    dims = spec.agent_action_dims or (spec.action_dim,)
    least, most = min(dims), max(dims)
    return (
        name,
        str(spec.n_agents),
        str(spec.observation_dim),
        f"{most if least == most else f'{least}-{most}'}{' choices' if spec.discrete_actions else ''}",
        str(spec.horizon_steps),
        str(spec.state_dim),
        f"{spec.step_seconds:g}",
    )


def _line(row: tuple[str, ...], widths: list[int]) -> str:
    name, *numbers = row
    return "  ".join((name.ljust(widths[0]), *map(str.rjust, numbers, widths[1:])))
