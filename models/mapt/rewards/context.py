"""The last steps of each environment, kept from one rollout to the next."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.rewards.errors import InvalidRollout

# Episode number of remembered steps that were never filled.
NO_EPISODE = -1


@dataclass(frozen=True, slots=True)
class RolloutSteps:
    """K remembered steps and the L of a rollout behind each other."""

    #: float32 (K + L, E, N, C)
    observations: NDArray[np.float32]
    #: float32 (K + L, E, N, A)
    actions: NDArray[np.float32]
    #: int64 (K + L, E), equal for the steps of one episode of one environment, NO_EPISODE where empty
    episode: NDArray[np.int64]


class RolloutContext:
    """The last K steps of E environments, and which episode each belongs to."""

    def __init__(self, n_steps: int, n_envs: int, n_agents: int, observation_dim: int, action_dim: int) -> None:
        self._steps = RolloutSteps(
            np.zeros((n_steps, n_envs, n_agents, observation_dim), dtype=np.float32),
            np.zeros((n_steps, n_envs, n_agents, action_dim), dtype=np.float32),
            np.full((n_steps, n_envs), NO_EPISODE, dtype=np.int64),
        )
        #: the running episode's number, per environment; kept apart since K may be 0
        self._episode = np.full(n_envs, NO_EPISODE, dtype=np.int64)

    def extend(self, observations: ArrayLike, actions: ArrayLike, episode_start: ArrayLike) -> RolloutSteps:
        """The remembered steps followed by these; the memory is left as it is.

        Raises:
            InvalidRollout: if a shape is wrong or a number not finite.
        """
        start = np.asarray(episode_start, dtype=np.bool_)
        if start.ndim != 2 or not len(start):
            raise InvalidRollout(f"episode_start has shape {start.shape}, expected (L, E) with L >= 1")
        parts = [
            self._joined(name, kept, values, len(start))
            for name, kept, values in (
                ("observations", self._steps.observations, observations),
                ("actions", self._steps.actions, actions),
            )
        ]
        if start.shape[1] != len(self._episode):
            raise InvalidRollout(f"episode_start is for {start.shape[1]} environments, not {len(self._episode)}")
        # The very first step begins an episode even when the caller starts in the middle of one.
        running = np.maximum(self._episode, 0)
        episode = np.concatenate((self._steps.episode, running + np.cumsum(start, axis=0)))
        return RolloutSteps(parts[0], parts[1], episode)

    @staticmethod
    def _joined(name: str, kept: NDArray[np.float32], values: ArrayLike, n_steps: int) -> NDArray[np.float32]:
        new = np.asarray(values, dtype=np.float32)
        expected = (n_steps, *kept.shape[1:])
        if new.shape != expected:
            raise InvalidRollout(f"{name} has shape {new.shape}, expected {expected}")
        if not np.isfinite(new).all():
            raise InvalidRollout(f"{name} holds NaN or infinity")
        return np.concatenate((kept, new))

    def keep(self, steps: RolloutSteps) -> None:
        """Remember the last K of `steps`."""
        first = len(steps.episode) - len(self._steps.episode)
        self._episode = steps.episode[-1]
        self._steps = RolloutSteps(
            steps.observations[first:].copy(), steps.actions[first:].copy(), steps.episode[first:].copy()
        )

    def state_dict(self) -> dict[str, NDArray[np.generic]]:
        """Copies of everything remembered."""
        return {
            "observations": self._steps.observations.copy(),
            "actions": self._steps.actions.copy(),
            "episode": self._steps.episode.copy(),
            "running_episode": self._episode.copy(),
        }

    def load_state_dict(self, state: dict[str, NDArray[np.generic]]) -> None:
        """Remember what another context of the same shape did.

        Raises:
            InvalidRollout: if an array is missing or has another shape.
        """
        own = self.state_dict()
        if set(state) != set(own):
            raise InvalidRollout(f"the context holds {sorted(state)}, expected {sorted(own)}")
        taken: dict[str, NDArray[np.generic]] = {}
        for name, array in own.items():
            if state[name].shape != array.shape:
                raise InvalidRollout(f"{name} has shape {state[name].shape}, expected {array.shape}")
            taken[name] = state[name].astype(array.dtype)
        self._steps = RolloutSteps(
            np.asarray(taken["observations"], dtype=np.float32),
            np.asarray(taken["actions"], dtype=np.float32),
            np.asarray(taken["episode"], dtype=np.int64),
        )
        self._episode = np.asarray(taken["running_episode"], dtype=np.int64)
