"""The two encoders of MAPT: co-operation within a step, then the past of each agent.

Both are stacks of pre-norm residual branches whose last layer starts at zero, so that an untrained encoder
passes its input through unchanged.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mapt.rewards.attention import AgentAttention, Band, CausalAttention, behind_context, zeroed
from mapt.rewards.config import RewardConfig


class FeedForward(nn.Module):
    """Two layers with a GELU between, on the last dimension; silent at the start."""

    def __init__(self, dim: int, inner_dim: int) -> None:
        super().__init__()
        self.inner = nn.Linear(dim, inner_dim)
        self.out = zeroed(nn.Linear(inner_dim, dim))

    def forward(self, x: Tensor) -> Tensor:
        return self.out(F.gelu(self.inner(x)))


class SegmentDropout(nn.Module):
    """Dropout of whole features of a segment: one draw for all its steps and agents.

    A draw per number would leave a mean over steps and agents, which is what a score is, nearly untouched;
    it also took a fifth of a training step on a CPU.
    """

    def __init__(self, probability: float) -> None:
        super().__init__()
        self.keep = 1.0 - probability

    def forward(self, x: Tensor) -> Tensor:
        """x (S, T, N, D)."""
        if not self.training or self.keep == 1.0:
            return x
        kept = torch.empty(len(x), 1, 1, x.shape[-1], device=x.device).bernoulli_(self.keep)
        return x * (kept / self.keep)


class CooperativeEmbedding(nn.Module):
    """Part I: (S, T, N, C) and (S, T, N, A) -> h (S, T, N, 2d)."""

    def __init__(self, config: RewardConfig) -> None:
        super().__init__()
        d = config.hidden_dim
        self.observation = nn.Linear(config.observation_dim, d)
        self.action = nn.Linear(config.action_dim, d)
        self.dropout = SegmentDropout(config.dropout)
        self.mixes_agents = config.agent_attention
        if self.mixes_agents:
            self.attention_norm = nn.LayerNorm(d)
            self.attention = AgentAttention(d, config.heads)
            self.feed_forward_norm = nn.LayerNorm(d)
            self.feed_forward = FeedForward(d, d)

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        x = F.gelu(self.observation(observations))
        if self.mixes_agents:
            x = x + self.dropout(self.attention(self.attention_norm(x)))
            x = x + self.dropout(self.feed_forward(self.feed_forward_norm(x)))
        return torch.cat((x, F.gelu(self.action(actions))), dim=-1)


class TemporalBlock(nn.Module):
    """Causal attention of width d on h (S, T, N, 2d), then a feed-forward layer."""

    def __init__(self, config: RewardConfig) -> None:
        super().__init__()
        width, d = 2 * config.hidden_dim, config.hidden_dim
        self.attention_norm = nn.LayerNorm(width)
        self.attention = CausalAttention(width, d, config.heads)
        self.feed_forward_norm = nn.LayerNorm(width)
        self.feed_forward = FeedForward(width, d)
        self.dropout = SegmentDropout(config.dropout)

    def forward(self, h: Tensor, band: Band | None = None) -> Tensor:
        mixed = self.attention(self.attention_norm(h), band)
        h = behind_context(h, band) + self.dropout(mixed)
        return h + self.dropout(self.feed_forward(self.feed_forward_norm(h)))


class TemporalLSTM(nn.Module):
    """An LSTM along T for each agent of h (S, T, N, 2d), in place of the attention (MAPT*)."""

    def __init__(self, config: RewardConfig) -> None:
        super().__init__()
        width, d = 2 * config.hidden_dim, config.hidden_dim
        self.norm = nn.LayerNorm(width)
        self.lstm = nn.LSTM(width, d, num_layers=config.layers, batch_first=True)
        self.out = zeroed(nn.Linear(d, width))
        self.dropout = SegmentDropout(config.dropout)

    def forward(self, h: Tensor) -> Tensor:
        s, t, n, width = h.shape
        by_agent = self.norm(h).transpose(1, 2).reshape(s * n, t, width)
        carried, _ = self.lstm(by_agent)
        carried = self.out(carried).view(s, n, t, width).transpose(1, 2)
        return h + self.dropout(carried)


class TemporalEncoder(nn.Module):
    """Carries the past of each agent to every step of h (S, T, N, 2d), as `config.temporal` says.

    A band's context is left out of what it gives; it is for one layer of attention at most.
    """

    def __init__(self, config: RewardConfig) -> None:
        super().__init__()
        self.blocks = nn.ModuleList()
        self.lstm = TemporalLSTM(config) if config.temporal == "lstm" else None
        if config.temporal == "attention":
            self.blocks.extend(TemporalBlock(config) for _ in range(config.layers))

    def forward(self, h: Tensor, band: Band | None = None) -> Tensor:
        if self.lstm is not None:
            return behind_context(self.lstm(h), band)
        for block in self.blocks:
            h = block(h, band)
        return h if self.blocks else behind_context(h, band)
