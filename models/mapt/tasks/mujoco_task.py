"""E copies of one MuJoCo body, stepped on threads, seen and driven by N agents."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from mapt.tasks.contact_forces import ContactForces
from mapt.tasks.errors import InvalidAction, InvalidSnapshot, InvalidTaskOption
from mapt.tasks.layout import as_slice
from mapt.tasks.protocol import TaskSpec, TaskStep
from mapt.tasks.random_state import generator_from_array, generator_to_array
from mapt.tasks.rules import Float64s, MujocoRules
from mapt.tasks.scene import MujocoScene
from mapt.tasks.team import Team


class MujocoTask:
    """A `Task` on `mujoco.batch`.

    A simulation is one row of integration state (time, qpos, qvel, warm start, controls), so a snapshot of the rows is
    the whole of the physics and a restored task goes on bit for bit.

    Args:
        spec, scene, rules: the task.
        team: who drives what and sees what.
        n_envs: environments, E.
        n_threads: threads that step them; 0 for one per core.
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
        team: Team,
        *,
        n_envs: int,
        n_threads: int,
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
        self._physics = {name: self._batch.bind(name) for name in ("time", "qpos", "qvel", "qacc_warmstart", "ctrl")}
        self._fields = {name: self._batch.bind(name) for name in rules.fields if name != "cfrc_ext"}
        self._forces = ContactForces(scene, self._batch, n_threads) if "cfrc_ext" in rules.fields else None

        layout = rules.layout(model.nq, model.nv)
        #: (E, R): every feature, then the 0 that stands for what an agent lacks, and last a 1.
        self._row = np.zeros((n_envs, layout.width + 1))
        self._row[:, -1] = 1.0
        self._frame = layout.views(self._row)
        self._before = {name: np.empty_like(self._frame[name]) for name in rules.before}
        self._state_columns = as_slice(np.array(layout.columns(rules.state)))
        self._columns = team.with_index(layout.zero, layout.width) if agent_index else team.observed
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

        reward = self._rules.reward(self._before, self._frame, self._controls)
        terminated = self._rules.terminated(self._frame)
        truncated = (self._elapsed_steps >= self._spec.horizon_steps) & ~terminated
        final_observations, final_state = observations, state = self._observe(slice(None))
        ended = np.flatnonzero(terminated | truncated)
        if ended.size:
            self._start_episodes(ended)
            observations, state = observations.copy(), state.copy()
            observations[ended], state[ended] = self._observe(ended)
        return TaskStep(observations, state, reward, terminated, truncated, final_observations, final_state)

    def simulator_state(self) -> tuple[Float64s, Float64s]:
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
        fields = {f"field.{name}": self._frame[name] for name in self._rules.fields}
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
            self._batch.step(nstep=self._rules.frame_skip)
        else:
            self._batch.step(nstep=self._rules.frame_skip - 1)
            self._forces.before_last_step()
            self._batch.step(nstep=1)
            np.copyto(self._frame["cfrc_ext"], self._forces.after_last_step())
        self._read_fields(slice(None))
        self._refresh()

    def _start_episodes(self, envs: NDArray[np.intp]) -> None:
        # What Batch.reset would do to a row, without its pass over everything else that a simulation holds.
        for field in self._physics.values():
            field[envs] = 0.0
        self._physics["qpos"][envs], self._physics["qvel"][envs] = self._rules.draw_start(self._rng, len(envs))
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
        self._rules.compute(self._frame)

    def _observe(self, envs: NDArray[np.intp] | slice) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Observations and state of these environments."""
        seen = self._row[envs].astype(self._dtype)
        observations = seen.take(self._columns.ravel(), axis=1).reshape(-1, *self._columns.shape)
        state = seen[:, self._state_columns]
        # A slice is a view of what is let go here; an index has made its own.
        return observations, state.copy() if isinstance(self._state_columns, slice) else state
