"""E copies of one MuJoCo body, stepped on threads, seen and driven by N agents."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from mapt.tasks.errors import InvalidAction, InvalidSnapshot, InvalidTaskOption
from mapt.tasks.partition import actuator_index, observation_index
from mapt.tasks.protocol import TaskSpec, TaskStep
from mapt.tasks.random_state import generator_from_array, generator_to_array
from mapt.tasks.scene import MujocoScene

Float64s = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MujocoRules:
    """What makes a scene a task: starts, rewards and ends, each for a batch of environments."""

    #: Physics steps per step of the task.
    frame_skip: int
    #: (generator, n) -> qpos (n, nq), qvel (n, nv) of n fresh episodes.
    draw_start: Callable[[np.random.Generator, int], tuple[Float64s, Float64s]]
    #: (qpos before, qpos after, controls (E, nu)) -> reward (E,).
    reward: Callable[[Float64s, Float64s, Float64s], Float64s]
    #: (qpos after, qvel after) -> terminated (E,) bool.
    terminated: Callable[[Float64s, Float64s], NDArray[np.bool_]]
    #: Columns of (qpos, qvel) that make the state.
    state_columns: slice


class MujocoTask:
    """A `Task` on `mujoco.batch`.

    A simulation is one row of integration state (time, qpos, qvel, warm start, controls), so a snapshot of the rows is
    the whole of the physics and a restored task goes on bit for bit.

    Args:
        spec, scene, rules: the task.
        n_envs: environments, E.
        n_threads: threads that step them; 0 for one per core.
        agent_obsk: how many edges away an agent sees its neighbours' positions.
        agent_index: append the agent's one-hot index to its observation.
        dtype: of observations and state. float64 is for comparisons with other simulators.

    Raises:
        InvalidTaskOption: if a number is out of its range.
    """

    def __init__(
        self,
        spec: TaskSpec,
        scene: MujocoScene,
        rules: MujocoRules,
        *,
        n_envs: int,
        n_threads: int,
        agent_obsk: int,
        agent_index: bool,
        dtype: type[np.floating],
    ) -> None:
        if n_envs < 1 or n_threads < 0:
            raise InvalidTaskOption(f"n_envs must be 1 or more and n_threads 0 or more, got {n_envs} and {n_threads}.")
        model = scene.load_model()
        self._spec = spec
        self._n_envs = n_envs
        self._rules = rules
        self._batch = Batch(model, n_envs, nthread=n_threads)
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._ctrl = self._batch.bind("ctrl")
        self._physics = {name: self._batch.bind(name) for name in ("time", "qpos", "qvel", "qacc_warmstart", "ctrl")}
        self._actuators = actuator_index(scene.partition).ravel()
        self._columns = observation_index(scene.partition, agent_obsk, model.nq, model.nv)
        self._dtype = dtype
        self._template = _empty_observations(n_envs, self._columns, agent_index, dtype)
        #: (E, nq + nv + 1): qpos, qvel and the 0 that stands for a missing neighbour.
        self._row = np.zeros((n_envs, model.nq + model.nv + 1))
        self._qpos_before = np.empty((n_envs, model.nq))
        self._controls = np.empty((n_envs, model.nu))
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
        return self._observe()

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        self._apply(actions)
        np.copyto(self._qpos_before, self._qpos)
        self._batch.step(nstep=self._rules.frame_skip)
        self._elapsed_steps += 1

        reward = self._rules.reward(self._qpos_before, self._qpos, self._controls)
        terminated = self._rules.terminated(self._qpos, self._qvel)
        truncated = (self._elapsed_steps >= self._spec.horizon_steps) & ~terminated
        final_observations, final_state = observations, state = self._observe()
        ended = np.flatnonzero(terminated | truncated)
        if ended.size:
            self._start_episodes(ended)
            observations, state = self._observe()
        return TaskStep(observations, state, reward, terminated, truncated, final_observations, final_state)

    def simulator_state(self) -> tuple[Float64s, Float64s]:
        return self._qpos.copy(), self._qvel.copy()

    def snapshot(self) -> dict[str, np.ndarray]:
        return {
            **{name: field.copy() for name, field in self._physics.items()},
            "elapsed_steps": self._elapsed_steps.copy(),
            "random_state": generator_to_array(self._rng),
        }

    def restore(self, snapshot: dict[str, np.ndarray]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        fields = {**self._physics, "elapsed_steps": self._elapsed_steps, "random_state": np.empty(6)}
        shapes = {name: field.shape for name, field in fields.items()}
        given = {name: np.shape(field) for name, field in snapshot.items()}
        if given != shapes:
            raise InvalidSnapshot(f"The snapshot holds {given}, but {self._spec.name} here needs {shapes}.")
        for name, field in self._physics.items():
            field[...] = snapshot[name]
        self._elapsed_steps[:] = snapshot["elapsed_steps"]
        self._rng = generator_from_array(snapshot["random_state"])
        return self._observe()

    def close(self) -> None:
        """Nothing is held beyond this object: the threads end with its batch."""

    def _apply(self, actions: NDArray[np.floating]) -> None:
        expected = (self._n_envs, self._spec.n_agents, self._spec.action_dim)
        if actions.shape != expected:
            raise InvalidAction(f"Actions must have the shape {expected}, got {actions.shape}.")
        self._controls[:, self._actuators] = actions.reshape(self._n_envs, -1)
        # A sum is finite only if every term is, and costs one pass.
        if not np.isfinite(self._controls.sum()):
            raise InvalidAction("Actions must be finite numbers.")
        self._ctrl[:] = self._controls

    def _start_episodes(self, envs: NDArray[np.intp]) -> None:
        qpos, qvel = self._rules.draw_start(self._rng, len(envs))
        self._batch.reset(envs, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._qpos[envs], self._qvel[envs] = qpos, qvel
        # Computes the accelerations from which the first step's solver warm-starts.
        self._batch.forward(envs)
        self._elapsed_steps[envs] = 0

    def _observe(self) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        nq = self._spec.nq
        self._row[:, :nq] = self._qpos
        self._row[:, nq:-1] = self._qvel
        observations = self._template.copy()
        observations[:, :, : self._columns.shape[1]] = self._row[:, self._columns]
        return observations, self._row[:, self._rules.state_columns].astype(self._dtype)


def _empty_observations(
    n_envs: int, columns: NDArray[np.intp], agent_index: bool, dtype: type[np.floating]
) -> NDArray[np.floating]:
    """(E, N, C) with the agents' one-hot indices in place and zeros elsewhere."""
    n_agents, width = columns.shape
    observations = np.zeros((n_envs, n_agents, width + n_agents * agent_index), dtype=dtype)
    if agent_index:
        observations[:, :, width:] = np.eye(n_agents, dtype=dtype)
    return observations
