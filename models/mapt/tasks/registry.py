"""The registry of tasks by name: built-in tasks, and those of the files that MAPT_TASKS names."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import os
import threading
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from itertools import chain
from pathlib import Path

import mujoco
import numpy as np

from mapt.errors import TaskExists, TaskImportFailed, UnknownTask
from mapt.tasks import smac_task
from mapt.tasks.football import task as football
from mapt.tasks.hands import catch, doors
from mapt.tasks.protocol import Drawing, DrawnDefinition, Task, TaskDefinition, TaskSpec
from mapt.tasks.robots import (
    ant,
    coupled_half_cheetah,
    half_cheetah,
    hopper,
    humanoid,
    many_segments,
    porters,
    pusher,
    reacher,
    swimmer,
    walker2d,
)
from mapt.tasks.skirmish import task as skirmish

#: Default distance in edges up to which an agent observes other joints: gymnasium-robotics' 1, not the paper's 0. With
#: 1, true returns were higher in every pair of runs. HalfCheetah-6x1 after 300,000 steps of MAPPO, seeds 0 and 1: 5,199
#: and 4,838 against 4,227 and 1,855 with separate actors, 1,855 and 1,964 against 1,636 and 1,321 with a shared actor.
DEFAULT_AGENT_OBSK = 1
#: Python files or modules that register tasks, separated as in PATH. Child processes inherit it.
TASK_FILES_VARIABLE = "MAPT_TASKS"

_MODULES = (
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
    porters,
    catch,
    doors,
)
_DEFINITIONS: dict[str, TaskDefinition] = {
    definition.name: definition
    for definition in chain(skirmish.TASKS, football.TASKS, *(module.TASKS for module in _MODULES))
}
_imported: set[str] = set()
#: re-entrant: a task file may look tasks up while it is imported
_import_lock = threading.RLock()


def register_task(definition: TaskDefinition) -> None:
    """Add a task to this process's registry. See docs/how-to/task.md.

    Raises:
        TaskExists: if the name is taken.
    """
    if definition.name in _DEFINITIONS:
        raise TaskExists(definition.name)
    _DEFINITIONS[definition.name] = definition


def task_names() -> tuple[str, ...]:
    """Names of all tasks, sorted. Many-segment robots exist in any size; only a few sizes are listed.

    Raises:
        TaskImportFailed: if a file or module that MAPT_TASKS names cannot be imported.
    """
    import_task_files()
    return tuple(sorted(_DEFINITIONS))


def task_spec(name: str, *, agent_obsk: int | None = DEFAULT_AGENT_OBSK, agent_index: bool = True) -> TaskSpec:
    """The spec of the task that `make_task` returns with the same options.

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
    """Make a batch of environments. Call `reset` before the first `step`.

    Args:
        n_envs: number of environments, E.
        n_threads: threads that step them; 0 for one per core.
        agent_obsk: agents observe the positions of joints up to this many edges away. None makes one agent that
            observes the state and drives every joint.
        agent_index: append the agent's one-hot index to its observation.
        dtype: of observations and state.

    Raises:
        UnknownTask: if no task has this name.
        InvalidConfig: if an option is out of range.
    """
    return find_definition(name).make(
        n_envs, n_threads=n_threads, agent_obsk=agent_obsk, agent_index=agent_index, dtype=dtype
    )


def load_model(task_name: str) -> mujoco.MjModel:
    """Compile a new copy of the task's MuJoCo model, which the caller may change.

    Raises:
        UnknownTask: if no task has this name.
        NoSimulator: if the task does not run on MuJoCo.
    """
    return find_definition(task_name).load_model()


def agent_geoms(task_name: str) -> tuple[tuple[int, ...], ...]:
    """Per agent, the ids of the geoms that it moves directly, which a renderer gives the agent's colour.

    Raises:
        UnknownTask: if no task has this name.
        NoSimulator: if the task does not run on MuJoCo.
    """
    return find_definition(task_name).agent_geoms()


def find_drawing(task_name: str) -> Drawing | None:
    """The drawing of the task's states; None if they are rendered by MuJoCo, or by the task itself.

    Raises:
        UnknownTask: if no task has this name.
    """
    definition = find_definition(task_name)
    return definition.drawing() if isinstance(definition, DrawnDefinition) else None


def frame_rate_hz(task_name: str) -> float:
    """Frames per second of the task's clips, of which each shows one step: real time, unless its drawing has another.

    Raises:
        UnknownTask: if no task has this name.
    """
    drawing = find_drawing(task_name)
    return 1.0 / task_spec(task_name).step_seconds if drawing is None else drawing.frame_rate_hz


def find_definition(name: str) -> TaskDefinition:
    """The definition with this name.

    Raises:
        UnknownTask: if no task has this name.
        TaskImportFailed: if a file or module that MAPT_TASKS names cannot be imported.
    """
    import_task_files()
    definition = _DEFINITIONS.get(name) or many_segments.definition(name) or smac_task.definition(name)
    if definition is None:
        raise UnknownTask(name, task_names())
    return definition


def task_files() -> list[str]:
    """The Python files and modules that MAPT_TASKS names."""
    return [name for name in os.environ.get(TASK_FILES_VARIABLE, "").split(os.pathsep) if name]


def import_task_files() -> None:
    """Import the files and modules that MAPT_TASKS names, each once per process. They call `register_task`.

    Raises:
        TaskImportFailed: if one is missing or raises an error.
    """
    # Another thread must not look up a task while this one still imports the file that registers it.
    with _import_lock:
        for name in task_files():
            if name not in _imported:
                _imported.add(name)
                try:
                    _import_file_or_module(name)
                except Exception as error:
                    _imported.discard(name)
                    raise TaskImportFailed(TASK_FILES_VARIABLE, name, error) from error


def _import_file_or_module(name: str) -> None:
    path = Path(name)
    if path.suffix != ".py":
        import_module(name)
        return
    spec = spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is not a Python file.")
    spec.loader.exec_module(module_from_spec(spec))


_HEADINGS = ("task", "N", "C", "A", "horizon", "state", "step, s")


def task_listing(agent_obsk: int) -> str:
    """A table of all tasks as text. Where agents drive different numbers of joints, column A shows the range.

    Args:
        agent_obsk: see `make_task`; observations grow with it.

    Raises:
        TaskImportFailed: if a file or module that MAPT_TASKS names cannot be imported.
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
