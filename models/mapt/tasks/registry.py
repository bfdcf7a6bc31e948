"""Tasks by name."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass

import mujoco
import numpy as np

from mapt.tasks import half_cheetah
from mapt.tasks.errors import UnknownTask
from mapt.tasks.mujoco_task import MujocoRules, MujocoTask
from mapt.tasks.partition import observation_index
from mapt.tasks.protocol import Task, TaskSpec
from mapt.tasks.scene import MujocoScene

#: How many joints away an agent sees when nobody says: gymnasium-robotics' 1, not the paper's 0. A joint that knows
#: its neighbours' angles learned more in every pair of runs. True return on HalfCheetah-6x1 after 300,000 steps of
#: MAPPO, seeds 0 and 1: 5,199 and 4,838 against 4,227 and 1,855 with actors of their own, 1,855 and 1,964 against
#: 1,636 and 1,321 with a shared one.
DEFAULT_AGENT_OBSK = 1


@dataclass(frozen=True, slots=True)
class _Entry:
    scene: MujocoScene
    rules: MujocoRules
    agent_names: tuple[str, ...]


_ENTRIES = {
    "HalfCheetah-6x1": _Entry(
        half_cheetah.ONE_JOINT_EACH,
        half_cheetah.RULES,
        ("back thigh", "back shin", "back foot", "front thigh", "front shin", "front foot"),
    ),
    "HalfCheetah-2x3": _Entry(half_cheetah.ONE_LEG_EACH, half_cheetah.RULES, ("back leg", "front leg")),
}


def task_names() -> tuple[str, ...]:
    """Names of all tasks, sorted."""
    return tuple(sorted(_ENTRIES))


def task_spec(name: str, *, agent_obsk: int = DEFAULT_AGENT_OBSK, agent_index: bool = True) -> TaskSpec:
    """What `make_task` with these options would give, without making it.

    Raises:
        UnknownTask: if no task has this name.
        InvalidTaskOption: if `agent_obsk` is negative.
    """
    entry = _entry(name)
    nq, nv = half_cheetah.NQ, half_cheetah.NV
    n_agents, width = observation_index(entry.scene.partition, agent_obsk, nq, nv).shape
    columns = entry.rules.state_columns
    return TaskSpec(
        name=name,
        n_agents=n_agents,
        observation_dim=width + n_agents * agent_index,
        action_dim=len(entry.scene.partition.agents[0]),
        state_dim=columns.stop - columns.start,
        horizon_steps=half_cheetah.HORIZON_STEPS,
        step_seconds=half_cheetah.STEP_SECONDS,
        agent_names=entry.agent_names,
        nq=nq,
        nv=nv,
        instructions=half_cheetah.INSTRUCTIONS,
    )


def make_task(
    name: str,
    n_envs: int,
    *,
    n_threads: int = 0,
    agent_obsk: int = DEFAULT_AGENT_OBSK,
    agent_index: bool = True,
    dtype: type[np.floating] = np.float32,
) -> Task:
    """A batch of environments of the task with this name; reset it before the first step.

    Args:
        n_envs: environments, E.
        n_threads: threads that step them; 0 for one per core.
        agent_obsk: how many edges away an agent sees its neighbours' positions.
        agent_index: append the agent's one-hot index to its observation.
        dtype: of observations and state.

    Raises:
        UnknownTask: if no task has this name.
        InvalidTaskOption: if a number is out of its range.
    """
    entry = _entry(name)
    return MujocoTask(
        task_spec(name, agent_obsk=agent_obsk, agent_index=agent_index),
        entry.scene,
        entry.rules,
        n_envs=n_envs,
        n_threads=n_threads,
        agent_obsk=agent_obsk,
        agent_index=agent_index,
        dtype=dtype,
    )


def load_model(task_name: str) -> mujoco.MjModel:
    """The model that the task simulates, compiled anew, for a renderer to alter as it likes.

    Raises:
        UnknownTask: if no task has this name.
    """
    return _entry(task_name).scene.load_model()


def agent_geoms(task_name: str) -> tuple[tuple[int, ...], ...]:
    """Per agent, ids of the geoms it moves directly: what a renderer colours to tell the agents apart.

    Raises:
        UnknownTask: if no task has this name.
    """
    return _entry(task_name).scene.agent_geoms()


def _entry(name: str) -> _Entry:
    if name not in _ENTRIES:
        raise UnknownTask(name, task_names())
    return _ENTRIES[name]
