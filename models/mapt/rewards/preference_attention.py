"""The two preference attentions of MAPT: who matters within a step, and which step matters."""

import math

import torch.nn.functional as F
from torch import Tensor, nn

from mapt.rewards.attention import zeroed


class CooperationAwareAttention(nn.Module):
    """Individual rewards from h by one head of attention among agents (CPA; paper, eq. 4)."""

    def __init__(self, dim: int, hidden_dim: int) -> None:
        super().__init__()
        self.query = nn.Linear(dim, hidden_dim)
        self.key = nn.Linear(dim, hidden_dim)
        self.value = nn.Linear(dim, hidden_dim)
        self.reward = nn.Linear(hidden_dim, 1)

    def forward(self, h: Tensor) -> Tensor:
        """h (S, T, N, 2d) -> (S, T, N)."""
        s, t, n, _ = h.shape
        query, key, value = (layer(h).view(s * t, 1, n, -1) for layer in (self.query, self.key, self.value))
        attended = F.scaled_dot_product_attention(query, key, value)
        return self.reward(attended).view(s, t, n)


class LinearReadOut(nn.Module):
    """Individual rewards from h, each agent by itself (MAPT-CPA)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.reward = nn.Linear(dim, 1)

    def forward(self, h: Tensor) -> Tensor:
        """h (S, T, N, 2d) -> (S, T, N)."""
        return self.reward(h).squeeze(-1)


class TemporalAwareAttention(nn.Module):
    """How each step of a segment attends to its steps (TPA; paper, the softmax of eq. 5).

    Its query starts at zero: every step then weighs the same until data asks otherwise.

    Args:
        dim: of what a step asks with, D.
        hidden_dim: d.
        key_dim: of what a step is asked by, K: N in MAPT, whose keys are the individual rewards.
    """

    def __init__(self, dim: int, hidden_dim: int, key_dim: int) -> None:
        super().__init__()
        self.query = zeroed(nn.Linear(dim, hidden_dim))
        self.key = nn.Linear(key_dim, hidden_dim)
        self.scale = 1 / math.sqrt(hidden_dim)

    def forward(self, asking: Tensor, asked: Tensor, mask: Tensor) -> Tensor:
        """What steps ask with (S, T, D), what they are asked by (S, T, K), mask (S, T) -> (S, asks, asked)."""
        query, key = self.query(asking), self.key(asked)
        logits = (query @ key.transpose(1, 2)) * self.scale
        return logits.masked_fill(~mask[:, None], float("-inf")).softmax(dim=-1)


def votes(shares: Tensor, mask: Tensor) -> Tensor:
    """Weights (S, T) of steps, the mean of what the real steps of `mask` (S, T) give them; 0 where masked, sum 1.

    Args:
        shares: how each step shares its vote, (S, step that asks, step asked).
    """
    voters = mask.to(shares.dtype)
    return (shares * voters[..., None]).sum(dim=1) / voters.sum(dim=1, keepdim=True)


def equal_weights(mask: Tensor) -> Tensor:
    """Weights (S, T) that share 1 equally among the real steps of `mask` (S, T)."""
    real = mask.float()
    return real / real.sum(dim=1, keepdim=True)
