"""Self-attention over the agents of a step, and causal self-attention over the steps of an agent."""

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mapt.rewards.config import RewardConfig
from mapt.rewards.kernels import Band, behind_context, small_products

# Wavelengths of the rotary positions run from 2 pi steps to about this many times as long: segments are
# tens to hundreds of steps, not the thousands of words for which 10,000 is usual.
ROTARY_BASE = 200.0


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


def in_float32(x: Tensor) -> AbstractContextManager[object]:
    """Within it, products on the device of `x` are taken in the type of their factors."""
    return torch.autocast(x.device.type, enabled=False)


class ScalarLinear(nn.Linear):
    """A linear map of (..., D) to one number, (..., 1)."""

    def __init__(self, dim: int) -> None:
        super().__init__(dim, 1)

    def forward(self, input: Tensor) -> Tensor:
        with in_float32(input):
            return super().forward(input.float())


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


# Beyond this many standard deviations an input says "far out" and no more: one wild state must not
# buy an unbounded reward.
CLIP_DEVIATIONS = 10.0
# A number that varies less than this in all training segments is taken as constant.
SMALLEST_DEVIATION = 1e-6


class InputNormaliser(nn.Module):
    """Shifts and scales each number by the mean and deviation over the training segments.

    The statistics are pooled over agents, so that the same rule holds for each of them.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("deviation", torch.ones(dim))

    @torch.no_grad()
    def measure(self, values: Tensor, mask: Tensor, readers: Sequence[tuple[nn.Linear, int]]) -> None:
        """Take the statistics of `values` (S, T, N, X) over the steps that `mask` (S, T) calls real.

        Args:
            readers: layers that read the normalised numbers, each with the column where they begin there.
                Their weights are changed so that they give what they gave before.
        """
        real = values[mask].reshape(-1, values.shape[-1]).double()
        measured = real.std(dim=0, correction=0)
        deviation = torch.where(measured < SMALLEST_DEVIATION, 1.0, measured).float()
        mean = real.mean(dim=0).float()
        for layer, offset in readers:
            weight = layer.weight[:, offset : offset + len(mean)]
            layer.bias.add_(weight @ ((mean - self.mean) / self.deviation))
            weight.mul_(deviation / self.deviation)
        self.mean.copy_(mean)
        self.deviation.copy_(deviation)

    def forward(self, values: Tensor) -> Tensor:
        """Normalise `values` (..., X)."""
        return ((values - self.mean) / self.deviation).clamp(-CLIP_DEVIATIONS, CLIP_DEVIATIONS)


class MarkovPath(nn.Module):
    """A reward of each agent's present step alone: (S, T, N, C + A) -> (S, T, N)."""

    def __init__(self, dim: int, hidden_dim: int) -> None:
        super().__init__()
        self.first = nn.Linear(dim, hidden_dim)
        self.second = nn.Linear(hidden_dim, hidden_dim)
        self.reward = ScalarLinear(hidden_dim)

    @classmethod
    def of(cls, config: RewardConfig) -> "MarkovPath | None":
        """The path of a network of these settings, if it has one."""
        if not config.markov_path:
            return None
        return cls(config.observation_dim + config.action_dim, config.markov_dim or config.hidden_dim)

    def forward(self, inputs: Tensor) -> Tensor:
        return self.reward(F.gelu(self.second(F.gelu(self.first(inputs))))).squeeze(-1)


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
