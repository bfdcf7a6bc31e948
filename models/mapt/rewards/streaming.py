"""Rewards one step at a time, inside any environment loop."""

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from mapt.rewards.bands import KeyValueRing
from mapt.rewards.base import PolicyReward, RewardModel
from mapt.rewards.errors import InvalidRollout
from mapt.rewards.relabelling import Credit, RolloutRelabeller, one_pass


class RewardStream:
    """Gives each step of E environments the reward r-hat_t computed from their last T transitions, as they happen.

    With one temporal attention layer, keys and values of the last T steps are kept, so that a step costs the network
    on that one step. What a second layer, an LSTM, or a kind of reward other than "value" reads of an earlier step
    depends on where the window begins, so there the window is run anew with every step, which costs T times as
    much. Both give what the network gives on the step's own window.

    Args:
        model: copied; its `reward_mean` and `reward_deviation` normalise what is given.
        window, n_envs, credit, device, kind: as in `RolloutRelabeller`.

    Raises:
        InvalidConfig: if an argument is out of its range.
    """

    def __init__(
        self,
        model: RewardModel,
        window: int,
        n_envs: int,
        credit: Credit = "shared",
        device: str = "cpu",
        *,
        kind: PolicyReward = "value",
    ) -> None:
        self._relabeller = RolloutRelabeller(model, window, n_envs, credit, device, kind=kind, precision="float32")
        self._model = self._relabeller.model
        self._device = self._model.reward_mean.device
        self._credit = credit
        self._shape = (n_envs, model.config.n_agents)
        self._ring: KeyValueRing | None = None
        if one_pass(model, kind):
            self._ring = KeyValueRing(window, n_envs, self._device)

    @torch.inference_mode()
    def step(self, observations: ArrayLike, actions: ArrayLike, episode_start: ArrayLike) -> NDArray[np.float32]:
        """Normalised rewards of the next step.

        Args:
            observations: (E, N, C), what the agents saw before they acted.
            actions: (E, N, A), one-hot where discrete.
            episode_start: bool (E,), true where the step is the first of its episode.

        Returns:
            float32 (E,) with shared credit, (E, N) with individual.

        Raises:
            InvalidRollout: if a shape is wrong or a number not finite; nothing is then remembered.
        """
        config = self._model.config
        observed = self._checked("observations", observations, config.observation_dim)
        acted = self._checked("actions", actions, config.action_dim)
        start = np.asarray(episode_start, dtype=np.bool_)
        if start.shape != self._shape[:1]:
            raise InvalidRollout(f"episode_start has shape {start.shape}, expected {self._shape[:1]}")
        if self._ring is None:
            return self._relabeller.relabel(observed[None], acted[None], start[None])[0]
        if start.any():
            self._ring.forget(torch.as_tensor(start, device=self._device))
        rewards = self._model.agent_rewards(self._one_step(observed), self._one_step(acted), self._ring)[:, 0]
        if self._credit == "shared":
            rewards = rewards.mean(dim=1)
        return self._model.normalised(rewards).cpu().numpy()

    def _checked(self, name: str, values: ArrayLike, width: int) -> NDArray[np.float32]:
        array = np.asarray(values, dtype=np.float32)
        expected = (*self._shape, width)
        if array.shape != expected:
            raise InvalidRollout(f"{name} has shape {array.shape}, expected {expected}")
        if not np.isfinite(array).all():
            raise InvalidRollout(f"{name} holds NaN or infinity")
        return array

    def _one_step(self, array: NDArray[np.float32]) -> Tensor:
        return torch.as_tensor(array, device=self._device)[:, None]
