"""A task of discrete actions whose right answer is known: each agent should choose what it is shown."""

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidAction, InvalidSnapshot
from mapt.tasks import TaskSpec, TaskStep
from mapt.tasks.snapshot import generator_from_array, generator_to_array

N_AGENTS = 2
N_CHOICES = 4


class ChoiceTask:
    """E environments; reward is the share of agents that choose what they are shown.

    The choice shown is always available, every other one half of the time. An agent that chooses at random among the
    available ones is right with probability `CHANCE`. Episodes are cut after `horizon_steps`.
    """

    #: Mean of 1 / (1 + k) where k of three other choices are available, each half of the time.
    CHANCE = (1 / 1 + 3 / 2 + 3 / 3 + 1 / 4) / 8

    def __init__(self, n_envs: int, horizon_steps: int = 8) -> None:
        self._n_envs = n_envs
        self._spec = TaskSpec(
            name="Choice",
            n_agents=N_AGENTS,
            observation_dim=N_CHOICES,
            action_dim=N_CHOICES,
            state_dim=N_AGENTS * N_CHOICES,
            horizon_steps=horizon_steps,
            step_seconds=1.0,
            agent_names=("one", "two"),
            nq=0,
            nv=0,
            instructions="Each agent should choose what it is shown.",
            discrete_actions=True,
        )
        self._rng = np.random.default_rng(0)
        self._shown = np.zeros((n_envs, N_AGENTS), dtype=np.int64)
        self._available = np.ones((n_envs, N_AGENTS, N_CHOICES), dtype=bool)
        self._elapsed_steps = np.zeros(n_envs, dtype=np.int64)

    @property
    def spec(self) -> TaskSpec:
        return self._spec

    @property
    def n_envs(self) -> int:
        return self._n_envs

    def available_actions(self) -> NDArray[np.bool_]:
        return self._available.copy()

    def reset(self, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        self._rng = np.random.default_rng(seed)
        self._elapsed_steps[:] = 0
        self._draw()
        return self._observe()

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        """Raises InvalidAction if an action is no single available choice."""
        chosen = actions.astype(bool)
        if not (chosen.sum(axis=-1) == 1).all() or (chosen & ~self._available).any():
            raise InvalidAction("An action is no single available choice.")
        reward = (actions.argmax(axis=-1) == self._shown).mean(axis=1)
        self._elapsed_steps += 1
        truncated = self._elapsed_steps >= self._spec.horizon_steps
        self._elapsed_steps[truncated] = 0
        self._draw()
        observations, state = self._observe()
        return TaskStep(observations, state, reward, np.zeros(self._n_envs, dtype=bool), truncated, observations, state)

    def simulator_state(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return np.zeros((self._n_envs, 0)), np.zeros((self._n_envs, 0))

    def snapshot(self) -> dict[str, np.ndarray]:
        return {
            "shown": self._shown.copy(),
            "available": self._available.copy(),
            "elapsed_steps": self._elapsed_steps.copy(),
            "random_state": generator_to_array(self._rng),
        }

    def restore(self, snapshot: dict[str, np.ndarray]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        if snapshot["shown"].shape != self._shown.shape:
            raise InvalidSnapshot(f"The snapshot is of {len(snapshot['shown'])} environments.")
        self._shown, self._available = snapshot["shown"].copy(), snapshot["available"].copy()
        self._elapsed_steps = snapshot["elapsed_steps"].copy()
        self._rng = generator_from_array(snapshot["random_state"])
        return self._observe()

    def close(self) -> None:
        """Nothing to free."""

    def _draw(self) -> None:
        self._shown = self._rng.integers(N_CHOICES, size=(self._n_envs, N_AGENTS))
        self._available = self._rng.random((self._n_envs, N_AGENTS, N_CHOICES)) < 0.5
        np.put_along_axis(self._available, self._shown[..., None], True, axis=-1)

    def _observe(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        observations = np.eye(N_CHOICES, dtype=np.float32)[self._shown]
        return observations, observations.reshape(self._n_envs, -1)
