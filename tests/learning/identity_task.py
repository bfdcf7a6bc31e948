"""A continuous task with a known optimum: each agent outputs the number it observes."""

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidSnapshot
from mapt.tasks import TaskSpec, TaskStep
from mapt.tasks.snapshot import generator_from_array, generator_to_array

N_AGENTS = 3


class IdentityTask:
    """E environments with episodes of `horizon_steps` steps; the reward is 1 minus the actions' mean squared error.

    The numbers are uniform in [-1, 1] and independent of the actions. The best return is `horizon_steps`; actions of
    zero get a reward of 2/3 per step on average.
    """

    def __init__(self, n_envs: int, horizon_steps: int = 8) -> None:
        self._n_envs = n_envs
        self._spec = TaskSpec(
            name="Identity",
            n_agents=N_AGENTS,
            observation_dim=2,
            action_dim=1,
            state_dim=N_AGENTS,
            horizon_steps=horizon_steps,
            step_seconds=1.0,
            agent_names=("one", "two", "three"),
            nq=N_AGENTS,
            nv=0,
            instructions="Each agent outputs the number it observes.",
        )
        self._rng = np.random.default_rng(0)
        self._targets = np.zeros((n_envs, N_AGENTS))
        self._elapsed_steps = np.zeros(n_envs, dtype=np.int64)

    @property
    def spec(self) -> TaskSpec:
        return self._spec

    @property
    def n_envs(self) -> int:
        return self._n_envs

    def reset(self, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        self._rng = np.random.default_rng(seed)
        self._elapsed_steps[:] = 0
        self._sample_targets()
        return self._observe()

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        reward = 1.0 - np.square(actions[..., 0] - self._targets).mean(axis=1)
        self._elapsed_steps += 1
        truncated = self._elapsed_steps >= self._spec.horizon_steps
        self._elapsed_steps[truncated] = 0
        self._sample_targets()
        observations, state = self._observe()
        return TaskStep(observations, state, reward, np.zeros(self._n_envs, dtype=bool), truncated, observations, state)

    def simulator_state(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self._targets.copy(), np.zeros((self._n_envs, 0))

    def snapshot(self) -> dict[str, np.ndarray]:
        return {
            "targets": self._targets.copy(),
            "elapsed_steps": self._elapsed_steps.copy(),
            "random_state": generator_to_array(self._rng),
        }

    def restore(self, snapshot: dict[str, np.ndarray]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        if snapshot["targets"].shape != self._targets.shape:
            raise InvalidSnapshot(f"The snapshot is of {len(snapshot['targets'])} environments.")
        self._targets = snapshot["targets"].copy()
        self._elapsed_steps = snapshot["elapsed_steps"].copy()
        self._rng = generator_from_array(snapshot["random_state"])
        return self._observe()

    def close(self) -> None:
        """Does nothing: there are no resources to free."""

    def _sample_targets(self) -> None:
        self._targets = self._rng.uniform(-1, 1, (self._n_envs, N_AGENTS))

    def _observe(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        targets = self._targets.astype(np.float32)
        return np.stack([targets, np.full_like(targets, 0.5)], axis=-1), targets.copy()
