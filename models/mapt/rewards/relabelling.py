"""Rewards of a whole rollout in one batched pass."""

import copy
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from mapt.rewards.bands import EpisodeBand
from mapt.rewards.base import PolicyReward, RewardModel
from mapt.rewards.context import RolloutContext
from mapt.rewards.device import resolve_device
from mapt.rewards.errors import InvalidConfig, ModelMismatch
from mapt.rewards.precision import products_in, resolve_precision
from mapt.rewards.train_config import Precision

Credit = Literal["shared", "individual"]
# Agent-steps in one pass: enough to fill the vector units, small enough that activations stay in cache
# and memory does not grow with the number of environments.
AGENT_STEPS_PER_PASS = 1 << 13


class RolloutRelabeller:
    """Gives each step of successive rollouts the reward r-hat_t computed from the last T transitions.

    It remembers the last T - 1 steps of each environment, so that a rollout's first steps see the end of the
    rollout before; no step sees across its episode's start. The rewards are those of the network run on each
    step's window by itself. Where an attention path was left out for want of a gain, that is the Markov path on
    each step. With one temporal attention layer, or none, that is one banded pass over the
    rollout; a second layer or an LSTM would carry older steps into the window, so there every window is
    encoded by itself, which costs T times as much. So it does for the kinds of reward other than r-hat itself: they
    read what the window's earlier steps are within that window.

    Args:
        model: its `reward_mean` and `reward_deviation` normalise what is given.
        window: T, at least 1; the length of the segments the model was trained on.
        n_envs: E.
        credit: "shared" gives every agent the mean over agents, "individual" each its own.
        device: as in `TrainConfig`.
        kind: as in `RewardModel.policy_rewards`: "value" is r-hat_t itself.
        precision: as in `TrainConfig`; rewards of bfloat16 products differ from the exact ones by a hundredth
            of their deviation or less.

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
        precision: Precision = "auto",
    ) -> None:
        if window < 1 or n_envs < 1:
            raise InvalidConfig(f"window is {window} and n_envs {n_envs}; both must be 1 or more")
        if credit not in get_args(Credit):
            raise InvalidConfig(f"credit is {credit!r}; known: {', '.join(get_args(Credit))}")
        if kind not in get_args(PolicyReward):
            raise InvalidConfig(f"kind is {kind!r}; known: {', '.join(get_args(PolicyReward))}")
        self._device = resolve_device(device)
        self._kind: PolicyReward = kind
        self._window = window
        self._credit = credit
        self._model = copy.deepcopy(model).to(self._device).eval()
        config = model.config
        self._products = resolve_precision(precision, config.hidden_dim, self._device)
        self._context = RolloutContext(window - 1, n_envs, config.n_agents, config.observation_dim, config.action_dim)

    @property
    def model(self) -> RewardModel:
        """The model in use."""
        return self._model

    def replace_model(self, model: RewardModel) -> None:
        """Go on with a newer model; the remembered steps stay.

        Raises:
            ModelMismatch: if it is for a task of other dimensions.
        """
        expected, found = self._model.config.dimensions, model.config.dimensions
        if expected != found:
            raise ModelMismatch("agents, observation and action dimension", expected, found)
        self._model = copy.deepcopy(model).to(self._device).eval()

    @torch.inference_mode()
    def relabel(self, observations: ArrayLike, actions: ArrayLike, episode_start: ArrayLike) -> NDArray[np.float32]:
        """Normalised rewards of a rollout that follows on the last one.

        Args:
            observations: (L, E, N, C).
            actions: (L, E, N, A).
            episode_start: bool (L, E), true where the step is the first of its episode.

        Returns:
            float32 (L, E) with shared credit, (L, E, N) with individual.

        Raises:
            InvalidRollout: if a shape is wrong or a number not finite; the memory is then unchanged.
        """
        steps = self._context.extend(observations, actions, episode_start)
        length = len(steps.episode) - (self._window - 1)
        observed, acted, episode = (
            torch.as_tensor(array, device=self._device).transpose(0, 1)
            for array in (steps.observations, steps.actions, steps.episode)
        )
        envs = max(1, AGENT_STEPS_PER_PASS // (len(steps.episode) * self._model.config.n_agents))
        parts = zip(observed.split(envs), acted.split(envs), episode.split(envs), strict=True)
        with products_in(self._products, self._device):
            rewards = torch.cat([self._rewards(*part, length=length) for part in parts]).float()
        if self._credit == "shared":
            rewards = rewards.mean(dim=2)
        self._context.keep(steps)
        return self._model.normalised(rewards).transpose(0, 1).contiguous().cpu().numpy()

    def _rewards(self, observations: Tensor, actions: Tensor, episode: Tensor, *, length: int) -> Tensor:
        """(E, T - 1 + L, N, C) and so on -> r-hat (E, L, N) of the last L steps."""
        if one_pass(self._model, self._kind):
            band = EpisodeBand(self._window, episode, context=self._window - 1)
            return self._model.agent_rewards(observations, actions, band)
        return self._window_by_window(observations, actions, episode, length)

    def _window_by_window(self, observations: Tensor, actions: Tensor, episode: Tensor, length: int) -> Tensor:
        window, before = self._window, self._window - 1
        own = episode.unfold(1, window, 1) == episode[:, before:, None]  # (E, L, T)
        n_own = own.sum(dim=2)
        # A window is moved to begin at the episode's first step; what then stands behind its last real
        # step cannot be seen by it.
        first = torch.arange(before, before + length, device=episode.device) + 1 - n_own
        index = first[..., None] + torch.arange(window, device=episode.device)
        index = index.clamp(max=before + length - 1)
        env = torch.arange(len(episode), device=episode.device)[:, None, None]
        env, index = env.expand_as(index).flatten(0, 1), index.flatten(0, 1)
        mask = torch.arange(window, device=episode.device) < n_own.flatten()[:, None]
        per_pass = max(1, AGENT_STEPS_PER_PASS // (window * observations.shape[2]))
        rewards = [
            self._model.policy_rewards(observations[e, i], actions[e, i], real, self._kind)
            for e, i, real in zip(env.split(per_pass), index.split(per_pass), mask.split(per_pass), strict=True)
        ]
        return torch.cat(rewards).view(len(episode), length, -1)

    def state_dict(self) -> dict[str, NDArray[np.generic]]:
        """Copies of the remembered steps; with the same model, `load_state_dict` goes on bit by bit."""
        return self._context.state_dict()

    def load_state_dict(self, state: dict[str, NDArray[np.generic]]) -> None:
        """Take up the remembered steps of another relabeller.

        Raises:
            InvalidRollout: if it had another window, number of environments or task.
        """
        self._context.load_state_dict(state)


def one_pass(model: RewardModel, kind: PolicyReward) -> bool:
    """Whether a step's reward needs of its past only what one attention layer reads there."""
    return kind == "value" and model.sees_one_window
