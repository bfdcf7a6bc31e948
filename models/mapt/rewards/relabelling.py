"""Rewards of a whole rollout in one batched pass."""

import copy
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from mapt.device import resolve_device
from mapt.errors import InvalidConfig, InvalidRollout, ModelMismatch
from mapt.rewards.config import Precision
from mapt.rewards.kernels import EpisodeBand, KeyValueRing, products_in, resolve_precision
from mapt.rewards.model import PolicyReward, RewardModel

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
