"""The models that MAPT is compared with, behind the same interface and built from the same layers."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mapt.rewards.config import RewardConfig
from mapt.rewards.layers import LinearHead, LocalAttention, MarkovPath, TemporalEncoder, drop_context, zero_init
from mapt.rewards.mapt import TemporalAwareAttention
from mapt.rewards.model import REWARD_GAIN, FirstLayers, RewardNetwork


class MarkovRewards(RewardNetwork):
    """MA-MLP: each agent's reward depends on its present step alone (Christiano et al., 2017)."""

    def __init__(self, config: RewardConfig) -> None:
        super().__init__(config)
        self.markov = MarkovPath.of(config)

    def _encode(self, inputs: tuple[Tensor, Tensor], local: LocalAttention | None) -> tuple[Tensor, Tensor]:
        """The observations as features, and r-hat (S, T, N)."""
        return drop_context(inputs[0], local), REWARD_GAIN * self._markov_output(inputs, local)

    def _first_layers(self) -> tuple[FirstLayers, FirstLayers]:
        return self._markov_first_layers()


class RecurrentRewards(RewardNetwork):
    """MA-LSTM: each agent's reward depends on its own past through an LSTM (Early et al., 2022)."""

    def __init__(self, config: RewardConfig) -> None:
        super().__init__(config)
        width = 2 * config.hidden_dim
        self.embedding = nn.Linear(config.observation_dim + config.action_dim, width)
        self.temporal = TemporalEncoder(config)
        self.read_out = LinearHead(width)
        self.markov = MarkovPath.of(config)
        if self.markov is not None:
            zero_init(self.read_out.reward)

    def _encode(self, inputs: tuple[Tensor, Tensor], local: LocalAttention | None) -> tuple[Tensor, Tensor]:
        """h (S, T, N, 2d) and r-hat (S, T, N)."""
        h = self.temporal(F.gelu(self.embedding(torch.cat(inputs, dim=-1))), local)
        return h, REWARD_GAIN * (self.read_out(h) + self._markov_output(inputs, local))

    def _first_layers(self) -> tuple[FirstLayers, FirstLayers]:
        observation, action = self._markov_first_layers()
        return (*observation, (self.embedding, 0)), (*action, (self.embedding, self.config.observation_dim))


class JointTransformer(RewardNetwork):
    """MA-Transformer: Preference Transformer (Kim et al., 2023) on the joint trajectory.

    A step is the concatenation of all agents' observations and actions. Causal attention encodes the past, one
    preference attention weighs the steps, and every agent receives the team's reward. The order of the agents
    matters.
    """

    def __init__(self, config: RewardConfig) -> None:
        super().__init__(config)
        d, width = config.hidden_dim, 2 * config.hidden_dim
        self.embedding = nn.Linear(config.n_agents * (config.observation_dim + config.action_dim), width)
        self.temporal = TemporalEncoder(config)
        self.read_out = LinearHead(width)
        self.step_weights = TemporalAwareAttention(width, d, width)
        self.markov = MarkovPath.of(config)
        if self.markov is not None:
            zero_init(self.read_out.reward)

    def _encode(self, inputs: tuple[Tensor, Tensor], local: LocalAttention | None) -> tuple[Tensor, Tensor]:
        """h (S, T, 1, 2d) and r-hat (S, T, N)."""
        joint = torch.cat([part.flatten(2) for part in inputs], dim=-1)
        h = self.temporal(F.gelu(self.embedding(joint))[:, :, None], local)
        return h, REWARD_GAIN * (self.read_out(h) + self._markov_output(inputs, local))

    def _step_attention(self, h: Tensor, agent_rewards: Tensor, mask: Tensor) -> Tensor:
        team = h.squeeze(2)
        return self.step_weights(team, team, mask)

    def _first_layers(self) -> tuple[FirstLayers, FirstLayers]:
        config = self.config
        observation, action = self._markov_first_layers()
        actions_at = config.n_agents * config.observation_dim
        return (
            (*observation, *((self.embedding, n * config.observation_dim) for n in range(config.n_agents))),
            (*action, *((self.embedding, actions_at + n * config.action_dim) for n in range(config.n_agents))),
        )
