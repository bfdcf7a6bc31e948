"""Self-attention over the agents of a step, and causal self-attention over the steps of an agent."""

from abc import ABC, abstractmethod

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mapt.rewards.precision import small_products

# Wavelengths of the rotary positions run from 2 pi steps to about this many times as long: segments are
# tens to hundreds of steps, not the thousands of words for which 10,000 is usual.
ROTARY_BASE = 200.0


class Band(ABC):
    """Which past a step may look at, where that is not all of its segment's."""

    @property
    def context_steps(self) -> int:
        """K, leading steps that are looked at alone: what comes out begins behind them."""
        return 0

    @abstractmethod
    def positions(self, n_steps: int) -> Tensor:
        """When each of T steps is, float64 (T,); only differences matter."""

    @abstractmethod
    def attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Mix values over the past of each step, (S, T - K, G, X), G the groups that do not see each other.

        Args:
            query: (S, T - K, G, X).
            key, value: (S, T, G, X).
        """


def behind_context(steps: Tensor, band: Band | None) -> Tensor:
    """The steps of (S, T, ...) that something is wanted for: (S, T - K, ...)."""
    return steps if band is None else steps[:, band.context_steps :]


class AgentAttention(nn.Module):
    """Multi-head attention among the N agents of each step."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(dim, dim)
        self.key = nn.Linear(dim, dim)
        self.value = nn.Linear(dim, dim)
        self.out = zeroed(nn.Linear(dim, dim))

    def forward(self, x: Tensor) -> Tensor:
        """Mix `x` (S, T, N, d) over N."""
        s, t, n, d = x.shape
        query, key, value = (
            part.reshape(s * t, n, self.heads, d // self.heads).transpose(1, 2)
            for part in side_by_side(x, self.query, self.key, self.value)
        )
        with small_products(x.device):
            mixed = F.scaled_dot_product_attention(query, key, value)
        return self.out(mixed.transpose(1, 2).reshape(s, t, n, d))


class CausalAttention(nn.Module):
    """Multi-head attention of each agent over its own past, with rotary (relative) positions."""

    def __init__(self, dim: int, inner_dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.head_dim = inner_dim // heads
        self.query = nn.Linear(dim, inner_dim)
        self.key = nn.Linear(dim, inner_dim)
        self.value = nn.Linear(dim, inner_dim)
        self.out = zeroed(nn.Linear(inner_dim, dim))

    def forward(self, x: Tensor, band: Band | None = None) -> Tensor:
        """Mix `x` (S, T, N, D) over T: each step sees itself and its past, or what `band` leaves of it.

        Returns:
            (S, T, N, D), or (S, T - K, N, D) behind the K steps of context of a band.
        """
        s, t, n, _ = x.shape
        context = 0 if band is None else band.context_steps
        if context:
            # A product over steps that lie apart in memory would be taken segment by segment.
            asking = x[:, context:].contiguous()
            parts = (*side_by_side(asking, self.query), *side_by_side(x, self.key, self.value))
        else:
            parts = side_by_side(x, self.query, self.key, self.value)
        # Agents and heads share one axis, so that no tensor is copied into another order.
        query, key, value = (part.reshape(s, -1, n * self.heads, self.head_dim) for part in parts)
        positions = torch.arange(t, dtype=torch.float64) if band is None else band.positions(t)
        cosine, sine = rotary_angles(positions, self.head_dim, x.device)
        with small_products(x.device):
            query, key = rotate(query, (cosine[context:], sine[context:])), rotate(key, (cosine, sine))
            mixed = _causal(query, key, value) if band is None else band.attend(query, key, value)
        return self.out(mixed.reshape(s, t - context, n, self.heads * self.head_dim))


def side_by_side(x: Tensor, *layers: nn.Linear) -> tuple[Tensor, ...]:
    """What each of `layers`, all of one width, makes of `x`, from one product; float32 on a CPU."""
    weight = torch.cat([layer.weight for layer in layers])
    bias = torch.cat([layer.bias for layer in layers])
    made = F.linear(x, weight, bias)
    return (made.float() if made.device.type == "cpu" else made).chunk(len(layers), dim=-1)


def rotary_angles(positions: Tensor, head_dim: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Cosine and sine (T, 1, head_dim / 2) of the rotation at each of `positions`, float64 (T,).

    Angles are float64: at step 1,000 a float32 angle is off by 1e-4, more than the windows may differ.
    """
    frequency = ROTARY_BASE ** -(torch.arange(0, head_dim, 2, dtype=torch.float64) / head_dim)
    angle = positions[:, None, None] * frequency
    return angle.cos().float().to(device), angle.sin().float().to(device)


def rotate(x: Tensor, rotation: tuple[Tensor, Tensor]) -> Tensor:
    """Turn the two halves of `x` (S, T, G, X) against each other by the angle of each step."""
    cosine, sine = rotation
    first, second = x.chunk(2, dim=-1)
    return torch.cat((first * cosine - second * sine, first * sine + second * cosine), dim=-1)


def zeroed(layer: nn.Linear) -> nn.Linear:
    """`layer` with weights and bias zero: a branch that ends in it is silent until data asks for it."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def _causal(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Attention of each step to itself and all before it; (S, T, G, X)."""
    query, key, value = (part.transpose(1, 2) for part in (query, key, value))
    return F.scaled_dot_product_attention(query, key, value, is_causal=True).transpose(1, 2)
