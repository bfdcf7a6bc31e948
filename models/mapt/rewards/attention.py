"""Self-attention over the agents of a step, and causal self-attention over the steps of an agent."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# Wavelengths of the rotary positions run from 2 pi steps to about this many times as long: segments are
# tens to hundreds of steps, not the thousands of words for which 10,000 is usual.
ROTARY_BASE = 200.0
# Episode numbers of the filler around a rollout: equal to no real one, nor to each other.
_FILLER_BEFORE = -2
_FILLER_AFTER = -3


@dataclass(frozen=True, slots=True)
class Band:
    """Which past a step of a rollout may look at: its own episode, `window` steps with itself."""

    window: int
    #: int64 (S, T), equal for steps of one episode; never below -1
    episode: Tensor


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
            layer(x).view(s * t, n, self.heads, d // self.heads).transpose(1, 2)
            for layer in (self.query, self.key, self.value)
        )
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
        """Mix `x` (S, T, N, D) over T: each step sees itself and its past, or what `band` leaves of it."""
        s, t, n, _ = x.shape
        # Agents and heads share one axis, so that no tensor is copied into another order.
        query, key, value = (
            layer(x).view(s, t, n * self.heads, self.head_dim) for layer in (self.query, self.key, self.value)
        )
        rotation = rotary_angles(t, self.head_dim, x.device)
        query, key = rotate(query, rotation), rotate(key, rotation)
        if band is None:
            mixed = F.scaled_dot_product_attention(
                query.transpose(1, 2), key.transpose(1, 2), value.transpose(1, 2), is_causal=True
            ).transpose(1, 2)
        else:
            mixed = banded_attention(query, key, value, band)
        return self.out(mixed.reshape(s, t, n, self.heads * self.head_dim))


def banded_attention(query: Tensor, key: Tensor, value: Tensor, band: Band) -> Tensor:
    """Causal attention within a window and an episode, at a cost linear in T.

    Queries go in blocks of one window; the keys of a block are its own steps and the window - 1 before.

    Args:
        query, key, value: (S, T, G, X), G the groups that do not see each other.

    Returns:
        (S, T, G, X).
    """
    s, t, g, x = query.shape
    block = max(band.window, 16)
    before, after = band.window - 1, -t % block
    n_blocks, span = (t + after) // block, block + before

    def blocks_of_keys(steps: Tensor) -> Tensor:
        padded = F.pad(steps, (0, 0, 0, 0, before, after))
        unfolded = padded.unfold(1, span, block)  # (S, blocks, G, X, span)
        return unfolded.permute(0, 1, 2, 4, 3).reshape(s * n_blocks, g, span, x)

    queries = F.pad(query, (0, 0, 0, 0, 0, after)).view(s * n_blocks, block, g, x).transpose(1, 2)
    visible = _visible(band, before, after, block, span).view(s * n_blocks, 1, block, span)
    mixed = F.scaled_dot_product_attention(queries, blocks_of_keys(key), blocks_of_keys(value), attn_mask=visible)
    return mixed.transpose(1, 2).reshape(s, n_blocks * block, g, x)[:, :t]


def _visible(band: Band, before: int, after: int, block: int, span: int) -> Tensor:
    """Bool (S, blocks, block, span): may this query see this key?"""
    asking = F.pad(band.episode, (0, after), value=_FILLER_AFTER)
    asked = F.pad(asking, (before, 0), value=_FILLER_BEFORE).unfold(1, span, block)
    asking = asking.view(len(asking), -1, block)
    steps = torch.arange(span, device=asking.device)
    age = steps[:block, None] + before - steps
    return (asking[..., None] == asked[:, :, None]) & (age >= 0) & (age < band.window)


def rotary_angles(n_steps: int, head_dim: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Cosine and sine (T, 1, head_dim / 2) of each step's rotation.

    Computed in float64: at step 1,000 a float32 angle is off by 1e-4, more than the windows may differ.
    """
    frequency = ROTARY_BASE ** -(torch.arange(0, head_dim, 2, dtype=torch.float64) / head_dim)
    angle = torch.arange(n_steps, dtype=torch.float64)[:, None, None] * frequency
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
