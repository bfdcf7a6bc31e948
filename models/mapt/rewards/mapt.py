"""MAPT, the Multi-Agent Preference Transformer (Zhu et al., 2024), with its ablations as settings.

The forward pass, in the order of the classes below:

1. `CooperativeEmbedding`: self-attention over the agents of a step embeds observations and actions into h.
2. `TemporalEncoder` (layers.py): causal self-attention over the steps of each agent.
3. `CooperationAwareAttention`: attention over agents turns h into individual rewards r-hat (eq. 4).
4. `TemporalAwareAttention`: attention over steps weighs the team's rewards (eq. 5), and their weighted sum is the
   segment's score (eq. 6), in `RewardNetwork.forward`.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mapt.rewards.config import RewardConfig
from mapt.rewards.layers import (
    AgentAttention,
    FeedForward,
    LinearHead,
    LocalAttention,
    MarkovPath,
    RewardHead,
    ScalarLinear,
    SegmentDropout,
    TemporalEncoder,
    full_precision,
    joint_linear,
    zero_init,
)
from mapt.rewards.model import REWARD_GAIN, FirstLayers, RewardNetwork


class CooperativeEmbedding(nn.Module):
    """Observations (S, T, N, C) and actions (S, T, N, A) -> h (S, T, N, 2d)."""

    def __init__(self, config: RewardConfig) -> None:
        super().__init__()
        d = config.hidden_dim
        self.observation = nn.Linear(config.observation_dim, d)
        self.action = nn.Linear(config.action_dim, d)
        self.dropout = SegmentDropout(config.dropout)
        self.has_attention = config.agent_attention
        if self.has_attention:
            self.attention_norm = nn.LayerNorm(d)
            self.attention = AgentAttention(d, config.heads)
            self.feed_forward_norm = nn.LayerNorm(d)
            self.feed_forward = FeedForward(d, d)

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        x = F.gelu(self.observation(observations))
        if self.has_attention:
            x = x + self.dropout(self.attention(self.attention_norm(x)))
            x = x + self.dropout(self.feed_forward(self.feed_forward_norm(x)))
        return torch.cat((x, F.gelu(self.action(actions))), dim=-1)


class CooperationAwareAttention(RewardHead):
    """Individual rewards from h by one head of attention over the agents of a step (CPA; paper, eq. 4)."""

    def __init__(self, dim: int, hidden_dim: int) -> None:
        super().__init__()
        self.query = nn.Linear(dim, hidden_dim)
        self.key = nn.Linear(dim, hidden_dim)
        self.value = nn.Linear(dim, hidden_dim)
        self.reward = ScalarLinear(hidden_dim)
        self.scale = 1 / math.sqrt(hidden_dim)

    def forward(self, h: Tensor) -> Tensor:
        """h (S, T, N, 2d) -> (S, T, N)."""
        weights = self.attention_weights(h)
        # The last layer is linear: the reward of a mean of values is the mean of their rewards, and a value's reward is
        # one product with h. This saves a product of d outputs, a twelfth of the network's.
        with full_precision(h):
            weight = self.reward.weight @ self.value.weight
            bias = F.linear(self.value.bias, self.reward.weight, self.reward.bias)
            return (weights @ F.linear(h.float(), weight, bias)).squeeze(-1)

    def attention_weights(self, h: Tensor) -> Tensor:
        """Weights (S, T, query agent, key agent); each query's sum to 1."""
        query, key = joint_linear(h, self.query, self.key)
        with full_precision(h):
            return (query.float() * self.scale @ key.float().transpose(2, 3)).softmax(dim=-1)


class TemporalAwareAttention(nn.Module):
    """Attention weights of each step of a segment over its steps (TPA; paper, the softmax of eq. 5).

    Queries start at zero, so that untrained weights are equal.

    Args:
        query_dim: of the query's input, D.
        hidden_dim: d.
        key_dim: of the key's input, K: in MAPT N, the individual rewards.
    """

    def __init__(self, query_dim: int, hidden_dim: int, key_dim: int) -> None:
        super().__init__()
        self.query = zero_init(nn.Linear(query_dim, hidden_dim))
        self.key = nn.Linear(key_dim, hidden_dim)
        self.scale = 1 / math.sqrt(hidden_dim)

    def forward(self, queries: Tensor, keys: Tensor, mask: Tensor) -> Tensor:
        """Weights (S, query step, key step) from queries (S, T, D), keys (S, T, K) and mask (S, T)."""
        query, key = self.query(queries), self.key(keys)
        with full_precision(queries):
            logits = query.float() * self.scale @ key.float().transpose(1, 2)
            return logits.masked_fill(~mask[:, None], float("-inf")).softmax(dim=-1)


class MAPT(RewardNetwork):
    """MAPT and its ablations.

    Individual rewards are the sum of a Markov path and the paper's attention path, which starts at zero: an untrained
    MAPT is a Markov model.

    Permuting the agents permutes their rewards. It may change the weights of steps: the keys of the temporal attention
    are the N rewards of a step in the order of the agents (paper, eq. 5).
    """

    def __init__(self, config: RewardConfig) -> None:
        super().__init__(config)
        d = config.hidden_dim
        self.embedding = CooperativeEmbedding(config)
        self.temporal = TemporalEncoder(config)
        self.read_out = CooperationAwareAttention(2 * d, d) if config.cpa else LinearHead(2 * d)
        key_dim = config.n_agents if config.tpa_key == "rewards" else 2 * d
        self.step_weights = TemporalAwareAttention(2 * d, d, key_dim) if config.tpa else None
        self.markov = MarkovPath.of(config)
        if self.markov is not None:
            zero_init(self.read_out.reward)

    def _encode(self, inputs: tuple[Tensor, Tensor], local: LocalAttention | None) -> tuple[Tensor, Tensor]:
        """h (S, T, N, 2d) and r-hat (S, T, N)."""
        h = self.temporal(self.embedding(*inputs), local)
        return h, REWARD_GAIN * (self.read_out(h) + self._markov_output(inputs, local))

    def _step_attention(self, h: Tensor, agent_rewards: Tensor, mask: Tensor) -> Tensor | None:
        if self.step_weights is None:
            return None
        team = h.mean(dim=2)
        # Without the gain, keys have the size of other activations, which keeps the softmax smooth.
        keys = agent_rewards / REWARD_GAIN if self.config.tpa_key == "rewards" else team
        return self.step_weights(team, keys, mask)

    def _reward_readers(self) -> Sequence[nn.Linear]:
        return [self.step_weights.key] if self.step_weights is not None and self.config.tpa_key == "rewards" else []

    def _first_layers(self) -> tuple[FirstLayers, FirstLayers]:
        observation, action = self._markov_first_layers()
        return (*observation, (self.embedding.observation, 0)), (*action, (self.embedding.action, 0))
