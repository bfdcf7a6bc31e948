"""The seam between tasks and everything above them: E environments stepped at once.

Dimension letters: E environments, N agents, C observation, A action, S state.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import mujoco
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class TaskSpec:
    """What a task is, without an environment of it."""

    #: Name by which the registry knows the task.
    name: str
    #: Agents in the team, N.
    n_agents: int
    #: Dimension of one agent's observation, C; agents that see less are padded with zeros.
    observation_dim: int
    #: Dimension of one agent's action, A, or the number of actions when discrete.
    action_dim: int
    #: Dimension of the state of the whole environment, S.
    state_dim: int
    #: Steps after which an episode is cut.
    horizon_steps: int
    #: Simulated time of one step.
    step_seconds: float
    #: One name per agent, in the order of the agent axis.
    agent_names: tuple[str, ...]
    #: Dimensions of the simulator's positions and velocities; 0 without a simulator state.
    nq: int
    nv: int
    #: What the team should achieve, in plain words for a labeller.
    instructions: str
    #: True when an action is one of `action_dim` choices, given as one-hot.
    discrete_actions: bool = False
    #: Continuous actions are meant to lie within plus and minus this.
    action_limit: float = 1.0
    #: Per agent, how many of the `action_dim` numbers it uses, the first ones; empty when all use all.
    agent_action_dims: tuple[int, ...] = ()
    #: True when not every discrete action is available in every state: the task is a `MaskingTask`.
    masks_actions: bool = False


@dataclass(slots=True)
class TaskStep:
    """What one step of E environments gave.

    Environments that ended were reset: `observations` and `state` belong to their next episode, `final_observations`
    and `final_state` to the end of the last one. For the others both are the same.
    """

    #: (E, N, C) float32.
    observations: NDArray[np.floating]
    #: (E, S) float32.
    state: NDArray[np.floating]
    #: (E,) float64, the task's own reward of the team.
    reward: NDArray[np.float64]
    #: (E,) bool: the episode ended in a state without a future.
    terminated: NDArray[np.bool_]
    #: (E,) bool: the episode was cut at the horizon; the state still had a future.
    truncated: NDArray[np.bool_]
    #: (E, N, C) float32, before any reset.
    final_observations: NDArray[np.floating]
    #: (E, S) float32, before any reset.
    final_state: NDArray[np.floating]


class Task(Protocol):
    """A batch of E environments of one task. Arrays handed out are never written to again."""

    @property
    def spec(self) -> TaskSpec: ...

    @property
    def n_envs(self) -> int: ...

    def reset(self, seed: int) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Start every environment anew; the seed decides all chance until the next reset.

        Returns:
            observations (E, N, C) and state (E, S).
        """
        ...

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        """Advance every environment by one step and reset those that ended.

        Args:
            actions: (E, N, A).

        Raises:
            InvalidAction: if the shape is another or a number is not finite.
        """
        ...

    def simulator_state(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Copies of qpos (E, nq) and qvel (E, nv) of the state that the newest observations describe."""
        ...

    def snapshot(self) -> dict[str, np.ndarray]:
        """Everything that decides the future, physics, elapsed steps and chance, as copies."""
        ...

    def restore(self, snapshot: dict[str, np.ndarray]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Continue exactly as the task that gave the snapshot would have.

        Returns:
            observations (E, N, C) and state (E, S) at that moment.

        Raises:
            InvalidSnapshot: if it was taken from another task or another number of environments.
        """
        ...

    def close(self) -> None:
        """Free what the simulator holds. The task is not used afterwards."""
        ...


@runtime_checkable
class MaskingTask(Task, Protocol):
    """A task of discrete actions, not all of them available in every state: its spec says `masks_actions`."""

    def available_actions(self) -> NDArray[np.bool_]:
        """(E, N, A) bool: what may be chosen in the state that the newest observations describe."""
        ...


@runtime_checkable
class RenderableTask(Task, Protocol):
    """A task that draws itself, for one that no MuJoCo model can be drawn from."""

    def render(self, env: int) -> NDArray[np.uint8]:
        """(height, width, 3): a picture of one environment as it is now.

        Raises:
            NotRenderable: if it does not draw itself.
        """
        ...


class TaskDefinition(Protocol):
    """A task by name. `MujocoDefinition` and `PettingZooDefinition` are the two kinds that exist."""

    @property
    def name(self) -> str: ...

    def spec(self, *, agent_obsk: int | None, agent_index: bool) -> TaskSpec:
        """What `make` with these options gives, cheaply.

        Raises:
            InvalidConfig: if `agent_obsk` is negative.
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


class WrappedTask:
    """Does what the task within does; a subclass overrides what it changes. It may stand for a `MaskingTask` too.

    Args:
        task: what is wrapped; closed with this one.
    """

    def __init__(self, task: Task) -> None:
        self._task = task

    @property
    def spec(self) -> TaskSpec:
        return self._task.spec

    @property
    def n_envs(self) -> int:
        return self._task.n_envs

    def reset(self, seed: int) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        return self._task.reset(seed)

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        return self._task.step(actions)

    def simulator_state(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self._task.simulator_state()

    def available_actions(self) -> NDArray[np.bool_] | None:
        """See `MaskingTask`; none if every action always is."""
        return self._task.available_actions() if isinstance(self._task, MaskingTask) else None

    def snapshot(self) -> dict[str, np.ndarray]:
        return self._task.snapshot()

    def restore(self, snapshot: dict[str, np.ndarray]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        return self._task.restore(snapshot)

    def close(self) -> None:
        self._task.close()
