"""MAPT, the Multi-Agent Preference Transformer (Zhu et al., 2024), as one configurable network."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mapt.preferences.errors import ShapeError
from mapt.rewards.attention import Band, zeroed
from mapt.rewards.config import RewardConfig
from mapt.rewards.encoders import CooperativeEmbedding, TemporalEncoder
from mapt.rewards.inputs import InputNormaliser
from mapt.rewards.preference_attention import (
    CooperationAwareAttention,
    LinearReadOut,
    TemporalAwareAttention,
    equal_weights,
)

# A score is a mean over steps and agents, so it starts near 0 and its logit must reach about 5 to be sure
# of a label. This factor on every reward spares the optimiser the way there.
REWARD_GAIN = 10.0
# A model that gives every step the same reward has deviation 0: it must not divide by it.
SMALLEST_REWARD_DEVIATION = 1e-6


@dataclass(frozen=True, slots=True)
class RewardOutput:
    """What MAPT says of S segments."""

    #: r-hat of each agent, float32 (S, T, N)
    agent_rewards: Tensor
    #: their mean over agents, (S, T)
    rewards: Tensor
    #: how much each step counts, (S, T): at least 0, 0 on padding, sum 1
    weights: Tensor
    #: weighted sum of the rewards, (S,): the logit of a preference is a difference of two of these
    score: Tensor


class MarkovPath(nn.Module):
    """A reward of each agent's present step alone: (S, T, N, C + A) -> (S, T, N)."""

    def __init__(self, dim: int, hidden_dim: int) -> None:
        super().__init__()
        self.first = nn.Linear(dim, hidden_dim)
        self.second = nn.Linear(hidden_dim, hidden_dim)
        self.reward = nn.Linear(hidden_dim, 1)

    def forward(self, inputs: Tensor) -> Tensor:
        return self.reward(F.gelu(self.second(F.gelu(self.first(inputs))))).squeeze(-1)


class MAPT(nn.Module):
    """Rewards of N agents that explain preferences between segments.

    Individual rewards are the sum of a Markov path and of the paper's attention path, which starts at zero:
    an untrained MAPT is a Markov model, and departs from it where data asks.
    """

    reward_mean: Tensor
    reward_deviation: Tensor

    def __init__(self, config: RewardConfig) -> None:
        super().__init__()
        self.config = config
        d = config.hidden_dim
        self.observation_normaliser = InputNormaliser(config.observation_dim)
        self.action_normaliser = InputNormaliser(config.action_dim)
        self.embedding = CooperativeEmbedding(config)
        self.temporal = TemporalEncoder(config)
        self.read_out = CooperationAwareAttention(2 * d, d) if config.cpa else LinearReadOut(2 * d)
        self.step_weights = TemporalAwareAttention(2 * d, d, config.n_agents) if config.tpa else None
        self.markov = MarkovPath(config.observation_dim + config.action_dim, d) if config.markov_path else None
        if self.markov is not None:
            zeroed(self.read_out.reward)
        self.register_buffer("reward_mean", torch.zeros(()))
        self.register_buffer("reward_deviation", torch.ones(()))

    def forward(self, observations: Tensor, actions: Tensor, mask: Tensor) -> RewardOutput:
        """Score segments.

        Args:
            observations: float32 (S, T, N, C).
            actions: float32 (S, T, N, A), one-hot where discrete.
            mask: bool (S, T), true where the step is real; real steps come first.

        Raises:
            ShapeError: if a shape does not fit the configuration.
        """
        self._check(observations, actions)
        if mask.shape != observations.shape[:2]:
            raise ShapeError("mask", tuple(mask.shape), f"{tuple(observations.shape[:2])}")
        inputs = self._normalised_inputs(observations, actions)
        h, agent_rewards = self._encode(inputs, None)
        rewards = agent_rewards.mean(dim=2)
        weigh = self.step_weights
        # Without the gain, the keys are of the size of other activations, and weights move as gently as they.
        weights = equal_weights(mask) if weigh is None else weigh(h.mean(dim=2), agent_rewards / REWARD_GAIN, mask)
        return RewardOutput(agent_rewards, rewards, weights, (weights * rewards).sum(dim=1))

    def agent_rewards(self, observations: Tensor, actions: Tensor, band: Band | None = None) -> Tensor:
        """r-hat (S, T, N) of every step from its past, as far back as `band` lets it see.

        Raises:
            ShapeError: if a shape does not fit the configuration.
        """
        self._check(observations, actions)
        return self._encode(self._normalised_inputs(observations, actions), band)[1]

    def markov_rewards(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The Markov path's part of r-hat, (S, T, N); zero where there is no such path."""
        return REWARD_GAIN * self._markov(self._normalised_inputs(observations, actions))

    def measure_inputs(self, observations: Tensor, actions: Tensor, mask: Tensor, *, keep_function: bool) -> None:
        """Take the input statistics from these segments (shapes as in `forward`).

        Args:
            keep_function: re-express the layers that read the inputs in the new units. A model that goes on
                training as the policy's states move then loses nothing (but for inputs beyond the clip).
        """
        parts = (
            (self.observation_normaliser, self.embedding.observation, observations, 0),
            (self.action_normaliser, self.embedding.action, actions, self.config.observation_dim),
        )
        for normaliser, layer, values, offset in parts:
            readers = [(layer, 0)]
            if self.markov is not None:
                readers.append((self.markov.first, offset))
            normaliser.measure(values, mask, readers if keep_function else ())

    def set_reward_scale(self, mean: float, deviation: float) -> None:
        """Record mean and deviation of the shared reward, which `normalised` takes away."""
        self.reward_mean.fill_(mean)
        self.reward_deviation.fill_(max(deviation, SMALLEST_REWARD_DEVIATION))

    def normalised(self, rewards: Tensor) -> Tensor:
        """Rewards in units of the recorded deviation. Agents share one scale, so that the mean over them
        is the shared reward's."""
        return (rewards - self.reward_mean) / self.reward_deviation

    @property
    def sees_one_window(self) -> bool:
        """Whether a `Band` bounds what a reward depends on: with a second layer, or an LSTM, it does not."""
        config = self.config
        return config.temporal == "none" or (config.temporal == "attention" and config.layers == 1)

    def _normalised_inputs(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        return self.observation_normaliser(observations), self.action_normaliser(actions)

    def _encode(self, inputs: tuple[Tensor, Tensor], band: Band | None) -> tuple[Tensor, Tensor]:
        h = self.temporal(self.embedding(*inputs), band)
        return h, REWARD_GAIN * (self.read_out(h) + self._markov(inputs))

    def _markov(self, inputs: tuple[Tensor, Tensor]) -> Tensor:
        if self.markov is None:
            return inputs[0].new_zeros(inputs[0].shape[:3])
        return self.markov(torch.cat(inputs, dim=-1))

    def _check(self, observations: Tensor, actions: Tensor) -> None:
        config = self.config
        expected = (config.n_agents, config.observation_dim)
        if observations.dim() != 4 or observations.shape[2:] != expected:
            raise ShapeError("observations", tuple(observations.shape), f"(S, T, {expected[0]}, {expected[1]})")
        expected = (*observations.shape[:3], config.action_dim)
        if actions.shape != expected:
            raise ShapeError("actions", tuple(actions.shape), f"{expected}")
