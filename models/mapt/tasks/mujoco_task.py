"""A partition as indices: which numbers each agent sees, and which actuators it drives."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from mapt.errors import InvalidAction, InvalidConfig, InvalidSnapshot
from mapt.tasks.contact_forces import ContactForces
from mapt.tasks.mujoco_definition import FloatArray, MujocoMdp, Robot
from mapt.tasks.partition import actuator_index, as_slice, observation_index
from mapt.tasks.protocol import Task, TaskSpec, TaskStep
from mapt.tasks.snapshot import generator_from_array, generator_to_array

#: Name of the one agent that sees the whole state and drives every joint.
WHOLE_TEAM = "whole team"


@dataclass(frozen=True, slots=True)
class AgentIndices:
    """N agents on one body."""

    #: (N, C): columns of the row, see `FeatureLayout`.
    observed: NDArray[np.intp]
    #: (N, A): actuators, -1 where an agent drives fewer than others.
    actuators: NDArray[np.intp]

    @classmethod
    def of(cls, robot: Robot, mdp: MujocoMdp, agent_obsk: int | None) -> "AgentIndices":
        """The team that the robot's partition makes.

        Args:
            agent_obsk: neighbours up to this many edges away are seen. None is MaMuJoCo's single agent: it sees the
                state and drives every joint, in the order of ctrl.

        Raises:
            InvalidConfig: if `agent_obsk` is negative.
        """
        layout = mdp.layout(robot.nq, robot.nv)
        actuators = actuator_index(robot.partition)
        if agent_obsk is None:
            return cls(np.array([layout.columns(mdp.state)]), np.sort(actuators[actuators >= 0])[None])
        return cls(observation_index(robot.partition, agent_obsk, layout), actuators)

    @property
    def action_dims(self) -> tuple[int, ...]:
        """Numbers of each agent's action that drive something; those after them are ignored."""
        return tuple(int(driven) for driven in (self.actuators >= 0).sum(axis=1))

    def with_agent_index(self, zero: int, one: int) -> NDArray[np.intp]:
        """(N, C + N): what is observed, then a one-hot index of the agent out of these two columns."""
        index = np.where(np.eye(len(self.observed), dtype=bool), one, zero)
        return np.concatenate([self.observed, index], axis=1)


class MujocoTask:
    """A `Task` on `mujoco.batch`.

    A simulation is one row of integration state (time, qpos, qvel, warm start, controls), so a snapshot of the rows is
    the whole of the physics and a restored task goes on bit for bit.

    Args:
        spec, robot, mdp: the task.
        team: who drives what and sees what.
        n_envs: environments, E.
        n_threads: threads that step them; 0 for one per core.
        agent_index: append the agent's one-hot index to its observation.
        dtype: of observations and state. float64 is for comparisons with other simulators.

    Raises:
        InvalidConfig: if a number is out of its range.
    """

    def __init__(
        self,
        spec: TaskSpec,
        robot: Robot,
        mdp: MujocoMdp,
        team: AgentIndices,
        *,
        n_envs: int,
        n_threads: int,
        agent_index: bool,
        dtype: type[np.floating],
    ) -> None:
        if n_envs < 1 or n_threads < 0:
            raise InvalidConfig(f"n_envs must be 1 or more and n_threads 0 or more, got {n_envs} and {n_threads}.")
        model = robot.load_model()
        self._spec = spec
        self._n_envs = n_envs
        self._mdp = mdp
        self._batch = Batch(model, n_envs, nthread=n_threads)
        self._physics = {name: self._batch.bind(name) for name in ("time", "qpos", "qvel", "qacc_warmstart", "ctrl")}
        self._fields = {name: self._batch.bind(name) for name in mdp.fields if name != "cfrc_ext"}
        self._forces = ContactForces(robot, self._batch, n_threads) if "cfrc_ext" in mdp.fields else None

        layout = mdp.layout(model.nq, model.nv)
        #: (E, R): every feature, then the 0 that stands for what an agent lacks, and last a 1.
        self._row = np.zeros((n_envs, layout.width + 1))
        self._row[:, -1] = 1.0
        self._frame = layout.views(self._row)
        self._before = {name: np.empty_like(self._frame[name]) for name in mdp.before}
        self._state_columns = as_slice(np.array(layout.columns(mdp.state)))
        self._columns = team.with_agent_index(layout.zero, layout.width) if agent_index else team.observed
        # In the order of ctrl: where every agent drives all that it could, both are unbroken runs.
        driven = np.flatnonzero(team.actuators >= 0)
        driven = driven[np.argsort(team.actuators.flat[driven])]
        self._driven, self._actuators = as_slice(driven), as_slice(team.actuators.flat[driven])
        self._dtype = dtype
        self._controls = np.zeros((n_envs, model.nu))
        self._elapsed_steps = np.zeros(n_envs, dtype=np.int64)
        self._rng = np.random.default_rng(0)

    @property
    def spec(self) -> TaskSpec:
        return self._spec

    @property
    def n_envs(self) -> int:
        return self._n_envs

    def reset(self, seed: int) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        self._rng = np.random.default_rng(seed)
        self._start_episodes(np.arange(self._n_envs))
        return self._observe(slice(None))

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        self._apply(actions)
        for name, feature in self._before.items():
            np.copyto(feature, self._frame[name])
        self._advance()
        self._elapsed_steps += 1

        reward = self._mdp.reward(self._before, self._frame, self._controls)
        terminated = self._mdp.terminated(self._frame)
        truncated = (self._elapsed_steps >= self._spec.horizon_steps) & ~terminated
        final_observations, final_state = observations, state = self._observe(slice(None))
        ended = np.flatnonzero(terminated | truncated)
        if ended.size:
            self._start_episodes(ended)
            observations, state = observations.copy(), state.copy()
            observations[ended], state[ended] = self._observe(ended)
        return TaskStep(observations, state, reward, terminated, truncated, final_observations, final_state)

    def simulator_state(self) -> tuple[FloatArray, FloatArray]:
        return self._physics["qpos"].copy(), self._physics["qvel"].copy()

    def snapshot(self) -> dict[str, np.ndarray]:
        return {name: field.copy() for name, field in self._kept().items()} | {
            "random_state": generator_to_array(self._rng)
        }

    def restore(self, snapshot: dict[str, np.ndarray]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        kept = self._kept()
        shapes = {**{name: field.shape for name, field in kept.items()}, "random_state": (6,)}
        given = {name: np.shape(field) for name, field in snapshot.items()}
        if given != shapes:
            raise InvalidSnapshot(f"The snapshot holds {given}, but {self._spec.name} here needs {shapes}.")
        for name, field in kept.items():
            field[...] = snapshot[name]
        self._rng = generator_from_array(snapshot["random_state"])
        self._refresh()
        return self._observe(slice(None))

    def close(self) -> None:
        """Nothing is held beyond this object: the threads end with its batch."""

    def _kept(self) -> dict[str, np.ndarray]:
        """What a snapshot holds beside the generator, to be read and written.

        Fields follow from the step that was, not from the state that it reached, so they are kept too.
        """
        fields = {f"field.{name}": self._frame[name] for name in self._mdp.fields}
        return {**self._physics, **fields, "elapsed_steps": self._elapsed_steps}

    def _apply(self, actions: NDArray[np.floating]) -> None:
        expected = (self._n_envs, self._spec.n_agents, self._spec.action_dim)
        if actions.shape != expected:
            raise InvalidAction(f"Actions must have the shape {expected}, got {actions.shape}.")
        self._controls[:, self._actuators] = actions.reshape(self._n_envs, -1)[:, self._driven]
        # A sum is finite only if every term is, and costs one pass.
        if not np.isfinite(self._controls.sum()):
            raise InvalidAction("Actions must be finite numbers.")
        self._physics["ctrl"][:] = self._controls

    def _advance(self) -> None:
        if self._forces is None:
            self._batch.step(nstep=self._mdp.frame_skip)
        else:
            self._batch.step(nstep=self._mdp.frame_skip - 1)
            self._forces.before_last_step()
            self._batch.step(nstep=1)
            np.copyto(self._frame["cfrc_ext"], self._forces.after_last_step())
        self._read_fields(slice(None))
        self._refresh()

    def _start_episodes(self, envs: NDArray[np.intp]) -> None:
        # What Batch.reset would do to a row, without its pass over everything else that a simulation holds.
        for field in self._physics.values():
            field[envs] = 0.0
        self._physics["qpos"][envs], self._physics["qvel"][envs] = self._mdp.sample_start(self._rng, len(envs))
        # Computes the accelerations from which the first step's solver warm-starts.
        self._batch.forward(envs)
        self._elapsed_steps[envs] = 0
        self._read_fields(envs)
        if self._forces is not None:
            self._frame["cfrc_ext"][envs] = 0.0
        self._refresh()

    def _read_fields(self, envs: NDArray[np.intp] | slice) -> None:
        for name, field in self._fields.items():
            self._frame[name][envs] = field[envs]

    def _refresh(self) -> None:
        """Bring the row up to the physics and the fields that it holds."""
        self._frame["qpos"][:] = self._physics["qpos"]
        self._frame["qvel"][:] = self._physics["qvel"]
        self._mdp.compute(self._frame)

    def _observe(self, envs: NDArray[np.intp] | slice) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Observations and state of these environments."""
        seen = self._row[envs].astype(self._dtype)
        observations = seen.take(self._columns.ravel(), axis=1).reshape(-1, *self._columns.shape)
        state = seen[:, self._state_columns]
        # A slice is a view of what is let go here; an index has made its own.
        return observations, state.copy() if isinstance(self._state_columns, slice) else state


@dataclass(frozen=True, slots=True)
class MujocoDefinition:
    """A task on MuJoCo: a body, its agents, and its mdp."""

    name: str
    robot: Robot
    mdp: MujocoMdp
    #: One per agent, in the order of the partition.
    agent_names: tuple[str, ...]
    #: What the team should achieve, in plain words for a labeller.
    instructions: str
    #: Steps after which an episode is cut.
    horizon_steps: int = 1000
    #: Actions are meant to lie within plus and minus this.
    action_limit: float = 1.0

    def spec(self, *, agent_obsk: int | None, agent_index: bool) -> TaskSpec:
        team = AgentIndices.of(self.robot, self.mdp, agent_obsk)
        n_agents, width = team.observed.shape
        dims = team.action_dims
        return TaskSpec(
            name=self.name,
            n_agents=n_agents,
            observation_dim=width + n_agents * agent_index,
            action_dim=max(dims),
            state_dim=len(self.mdp.state),
            horizon_steps=self.horizon_steps,
            step_seconds=self.mdp.frame_skip * self.robot.physics_step_seconds,
            agent_names=(WHOLE_TEAM,) if agent_obsk is None else self.agent_names,
            nq=self.robot.nq,
            nv=self.robot.nv,
            instructions=self.instructions,
            action_limit=self.action_limit,
            agent_action_dims=dims,
        )

    def make(
        self, n_envs: int, *, n_threads: int, agent_obsk: int | None, agent_index: bool, dtype: type[np.floating]
    ) -> Task:
        return MujocoTask(
            self.spec(agent_obsk=agent_obsk, agent_index=agent_index),
            self.robot,
            self.mdp,
            AgentIndices.of(self.robot, self.mdp, agent_obsk),
            n_envs=n_envs,
            n_threads=n_threads,
            agent_index=agent_index,
            dtype=dtype,
        )

    def load_model(self) -> mujoco.MjModel:
        return self.robot.load_model()

    def agent_geoms(self) -> tuple[tuple[int, ...], ...]:
        return self.robot.agent_geoms()
