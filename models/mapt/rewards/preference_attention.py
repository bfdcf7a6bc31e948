"""The two preference attentions of MAPT: who matters within a step, and which step matters.

Both end in few numbers, so that two of their linear maps in a row are one smaller map. Parameters are those of
the paper's equations; the products are taken anew in every forward pass.
"""

import math

import torch.nn.functional as F
from torch import Tensor, nn

from mapt.rewards.attention import zeroed
from mapt.rewards.scalar import ScalarLinear, in_float32


class ReadOut(nn.Module):
    """Individual rewards (S, T, N) from h (S, T, N, 2d), by a path that may see the past."""

    #: its last layer
    reward: ScalarLinear


class CooperationAwareAttention(ReadOut):
    """Individual rewards from h by one head of attention among agents (CPA; paper, eq. 4).

    An attended value goes through one Linear to a scalar. A softmax sums to 1, so that attending scalars gives the
    same: value and reward are one map from 2d to 1, instead of one from 2d to d for every agent and step.
    """

    def __init__(self, dim: int, hidden_dim: int) -> None:
        super().__init__()
        self.query = nn.Linear(dim, hidden_dim)
        self.key = nn.Linear(dim, hidden_dim)
        self.value = nn.Linear(dim, hidden_dim)
        self.reward = ScalarLinear(hidden_dim)
        self.scale = 1 / math.sqrt(hidden_dim)

    def forward(self, h: Tensor) -> Tensor:
        """h (S, T, N, 2d) -> (S, T, N)."""
        shares = self.shares(h)
        with in_float32(h):
            weight, bias = self.reward.weight @ self.value.weight, self.reward(self.value.bias)
            return (shares @ F.linear(h.float(), weight, bias)).squeeze(-1)

    def shares(self, h: Tensor) -> Tensor:
        """How each agent attends to the agents of its step, (S, T, agent that asks, agent asked), sum 1."""
        # For few agents this is several times as fast on a CPU as a fused attention, which is made for long sequences.
        query, key = self.query(h), self.key(h)
        with in_float32(h):
            return (query.float() * self.scale @ key.float().transpose(2, 3)).softmax(dim=-1)


class LinearReadOut(ReadOut):
    """Individual rewards from h, each agent by itself (MAPT-CPA)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.reward = ScalarLinear(dim)

    def forward(self, h: Tensor) -> Tensor:
        """h (S, T, N, 2d) -> (S, T, N)."""
        return self.reward(h).squeeze(-1)


class TemporalAwareAttention(nn.Module):
    """How each step of a segment attends to its steps (TPA; paper, the softmax of eq. 5).

    Its query starts at zero: every step then weighs the same until data asks otherwise. A key of fewer numbers than d
    is not mapped to d: <Q, W r + b> = <W'Q, r> + <Q, b>, and the last term, the same for every step asked,
    leaves the softmax as it is. So the bias of the key is never learned; it is kept for the models stored with it.

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
        self.folds = key_dim < hidden_dim

    def forward(self, asking: Tensor, asked: Tensor, mask: Tensor) -> Tensor:
        """What steps ask with (S, T, D), what they are asked by (S, T, K), mask (S, T) -> (S, asks, asked)."""
        if self.folds:
            with in_float32(asking):
                fold = self.key.weight.T * self.scale
                query = F.linear(asking.float(), fold @ self.query.weight, fold @ self.query.bias)
            key = asked
        else:
            query, key = self.query(asking) * self.scale, self.key(asked)
        with in_float32(asking):
            logits = query.float() @ key.float().transpose(1, 2)
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
