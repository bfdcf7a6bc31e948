"""What the registry holds for a name: how to describe and make a task."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

from mapt.tasks.mujoco_task import MujocoTask
from mapt.tasks.protocol import Task, TaskSpec
from mapt.tasks.rules import MujocoRules
from mapt.tasks.scene import MujocoScene
from mapt.tasks.team import WHOLE_TEAM, Team


class TaskEntry(Protocol):
    """A task by name. `MujocoEntry` and `ParallelEntry` are the two kinds that exist."""

    @property
    def name(self) -> str: ...

    def spec(self, *, agent_obsk: int | None, agent_index: bool) -> TaskSpec:
        """What `make` with these options gives, cheaply.

        Raises:
            InvalidTaskOption: if `agent_obsk` is negative.
        """
        ...

    def make(
        self, n_envs: int, *, n_threads: int, agent_obsk: int | None, agent_index: bool, dtype: type[np.floating]
    ) -> Task:
        """See `make_task`."""
        ...

    def load_model(self) -> mujoco.MjModel:
        """The model that is simulated.

        Raises:
            NoSimulator: if the task has none.
        """
        ...

    def agent_geoms(self) -> tuple[tuple[int, ...], ...]:
        """Per agent, the ids of its geoms.

        Raises:
            NoSimulator: if the task has none.
        """
        ...


@dataclass(frozen=True, slots=True)
class MujocoEntry:
    """A task on MuJoCo: a body, its agents, and its rules."""

    name: str
    scene: MujocoScene
    rules: MujocoRules
    #: One per agent, in the order of the partition.
    agent_names: tuple[str, ...]
    #: What the team should achieve, in plain words for a labeller.
    instructions: str
    #: Steps after which an episode is cut.
    horizon_steps: int = 1000
    #: Actions are meant to lie within plus and minus this.
    action_limit: float = 1.0

    def spec(self, *, agent_obsk: int | None, agent_index: bool) -> TaskSpec:
        team = Team.of(self.scene, self.rules, agent_obsk)
        n_agents, width = team.observed.shape
        dims = team.action_dims
        return TaskSpec(
            name=self.name,
            n_agents=n_agents,
            observation_dim=width + n_agents * agent_index,
            action_dim=max(dims),
            state_dim=len(self.rules.state),
            horizon_steps=self.horizon_steps,
            step_seconds=self.rules.frame_skip * self.scene.physics_step_seconds,
            agent_names=(WHOLE_TEAM,) if agent_obsk is None else self.agent_names,
            nq=self.scene.nq,
            nv=self.scene.nv,
            instructions=self.instructions,
            action_limit=self.action_limit,
            agent_action_dims=dims,
        )

    def make(
        self, n_envs: int, *, n_threads: int, agent_obsk: int | None, agent_index: bool, dtype: type[np.floating]
    ) -> Task:
        return MujocoTask(
            self.spec(agent_obsk=agent_obsk, agent_index=agent_index),
            self.scene,
            self.rules,
            Team.of(self.scene, self.rules, agent_obsk),
            n_envs=n_envs,
            n_threads=n_threads,
            agent_index=agent_index,
            dtype=dtype,
        )

    def load_model(self) -> mujoco.MjModel:
        return self.scene.load_model()

    def agent_geoms(self) -> tuple[tuple[int, ...], ...]:
        return self.scene.agent_geoms()
