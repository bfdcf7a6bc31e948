"""The models MAPT is measured against, behind the same interface and with the same parts."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mapt.rewards.config import RewardConfig
from mapt.rewards.kernels import Band, behind_context
from mapt.rewards.layers import LinearReadOut, MarkovPath, TemporalAwareAttention, TemporalEncoder, zeroed
from mapt.rewards.model import REWARD_GAIN, Readers, RewardModel


class MarkovRewards(RewardModel):
    """MA-MLP: each agent's reward sees its present step alone (Christiano et al., 2017)."""

    def __init__(self, config: RewardConfig) -> None:
        super().__init__(config)
        self.markov = MarkovPath.of(config)

    def _encode(self, inputs: tuple[Tensor, Tensor], band: Band | None) -> tuple[Tensor, Tensor]:
        """The observations themselves, and r-hat (S, T, N)."""
        return behind_context(inputs[0], band), REWARD_GAIN * self._markov(inputs, band)

    def _readers(self) -> tuple[Readers, Readers]:
        return self._markov_readers()


class RecurrentRewards(RewardModel):
    """MA-LSTM: each agent's reward sees its own past through an LSTM (Early et al., 2022)."""

    def __init__(self, config: RewardConfig) -> None:
        super().__init__(config)
        width = 2 * config.hidden_dim
        self.embedding = nn.Linear(config.observation_dim + config.action_dim, width)
        self.temporal = TemporalEncoder(config)
        self.read_out = LinearReadOut(width)
        self.markov = MarkovPath.of(config)
        if self.markov is not None:
            zeroed(self.read_out.reward)

    def _encode(self, inputs: tuple[Tensor, Tensor], band: Band | None) -> tuple[Tensor, Tensor]:
        """h (S, T, N, 2d) and r-hat (S, T, N)."""
        h = self.temporal(F.gelu(self.embedding(torch.cat(inputs, dim=-1))), band)
        return h, REWARD_GAIN * (self.read_out(h) + self._markov(inputs, band))

    def _readers(self) -> tuple[Readers, Readers]:
        observation, action = self._markov_readers()
        return (*observation, (self.embedding, 0)), (*action, (self.embedding, self.config.observation_dim))


class JointTransformer(RewardModel):
    """MA-Transformer: Preference Transformer (Kim et al., 2023) on the joint trajectory.

    A step is what all agents observe and do, side by side; causal layers carry the past to it, one preference
    attention over the steps weighs it. Its reward is the team's, given to every agent; it knows agents by
    their place, so that to permute them is to show it another team.
    """

    def __init__(self, config: RewardConfig) -> None:
        super().__init__(config)
        d, width = config.hidden_dim, 2 * config.hidden_dim
        self.embedding = nn.Linear(config.n_agents * (config.observation_dim + config.action_dim), width)
        self.temporal = TemporalEncoder(config)
        self.read_out = LinearReadOut(width)
        self.step_weights = TemporalAwareAttention(width, d, width)
        self.markov = MarkovPath.of(config)
        if self.markov is not None:
            zeroed(self.read_out.reward)

    def _encode(self, inputs: tuple[Tensor, Tensor], band: Band | None) -> tuple[Tensor, Tensor]:
        """h (S, T, 1, 2d) and r-hat (S, T, N)."""
        joint = torch.cat([part.flatten(2) for part in inputs], dim=-1)
        h = self.temporal(F.gelu(self.embedding(joint))[:, :, None], band)
        return h, REWARD_GAIN * (self.read_out(h) + self._markov(inputs, band))

    def _shares(self, h: Tensor, agent_rewards: Tensor, mask: Tensor) -> Tensor:
        team = h.squeeze(2)
        return self.step_weights(team, team, mask)

    def _readers(self) -> tuple[Readers, Readers]:
        config = self.config
        observation, action = self._markov_readers()
        actions_at = config.n_agents * config.observation_dim
        return (
            (*observation, *((self.embedding, n * config.observation_dim) for n in range(config.n_agents))),
            (*action, *((self.embedding, actions_at + n * config.action_dim) for n in range(config.n_agents))),
        )
