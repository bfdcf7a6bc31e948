"""MAPT, the Multi-Agent Preference Transformer (Zhu et al., 2024), as one configurable network."""

from torch import Tensor

from mapt.rewards.config import RewardConfig
from mapt.rewards.kernels import Band
from mapt.rewards.layers import (
    CooperationAwareAttention,
    CooperativeEmbedding,
    LinearReadOut,
    MarkovPath,
    TemporalAwareAttention,
    TemporalEncoder,
    zeroed,
)
from mapt.rewards.model import REWARD_GAIN, Readers, RewardModel, RewardOutput

__all__ = ["MAPT", "REWARD_GAIN", "RewardOutput"]


class MAPT(RewardModel):
    """MAPT and its variants.

    Individual rewards are the sum of a Markov path and of the paper's attention path, which starts at zero:
    an untrained MAPT is a Markov model, and departs from it where data asks.

    To permute the agents permutes their rewards. It may move the weights of the steps all the same: the keys of the
    temporal attention read the N rewards of a step in the order of the agents, as the paper's eq. 5 has it.
    """

    def __init__(self, config: RewardConfig) -> None:
        super().__init__(config)
        d = config.hidden_dim
        self.embedding = CooperativeEmbedding(config)
        self.temporal = TemporalEncoder(config)
        self.read_out = CooperationAwareAttention(2 * d, d) if config.cpa else LinearReadOut(2 * d)
        key_dim = config.n_agents if config.tpa_key == "rewards" else 2 * d
        self.step_weights = TemporalAwareAttention(2 * d, d, key_dim) if config.tpa else None
        self.markov = MarkovPath.of(config)
        if self.markov is not None:
            zeroed(self.read_out.reward)

    def _encode(self, inputs: tuple[Tensor, Tensor], band: Band | None) -> tuple[Tensor, Tensor]:
        """h (S, T, N, 2d) and r-hat (S, T, N)."""
        h = self.temporal(self.embedding(*inputs), band)
        return h, REWARD_GAIN * (self.read_out(h) + self._markov(inputs, band))

    def _shares(self, h: Tensor, agent_rewards: Tensor, mask: Tensor) -> Tensor | None:
        if self.step_weights is None:
            return None
        team = h.mean(dim=2)
        # Without the gain, the keys are of the size of other activations, and weights move as gently as they.
        asked = agent_rewards / REWARD_GAIN if self.config.tpa_key == "rewards" else team
        return self.step_weights(team, asked, mask)

    def _readers(self) -> tuple[Readers, Readers]:
        observation, action = self._markov_readers()
        return (*observation, (self.embedding.observation, 0)), (*action, (self.embedding.action, 0))
