"""Layers that MAPT and the baselines share.

Residual branches end in a layer whose weights start at zero, so that an untrained branch passes its input through
unchanged. Attribute names are the names of the weights in stored models: renaming one needs a migration.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mapt.rewards.config import RewardConfig

# Inputs are clipped to this many standard deviations: one outlier must not produce an unbounded reward.
INPUT_LIMIT = 10.0
# An input with a smaller standard deviation counts as constant and is not scaled.
MIN_DEVIATION = 1e-6
# Wavelengths of the rotary positions range from 2 pi steps to about this many times as long. The usual 10,000 suits
# texts of thousands of words; segments have tens to hundreds of steps.
ROTARY_BASE = 200.0


class InputNormaliser(nn.Module):
    """Standardises each input by its mean and standard deviation over the training segments.

    The statistics are pooled over agents, so that all agents share one scale. They are fitted once per training and
    stored with the model; those of a policy (`mapt.policies.normalisation`) grow with every rollout.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("deviation", torch.ones(dim))

    @torch.no_grad()
    def fit(self, values: Tensor, mask: Tensor, first_layers: Sequence[tuple[nn.Linear, int]]) -> None:
        """Set the statistics to those of `values` (S, T, N, X) over the real steps of `mask` (S, T).

        Args:
            first_layers: layers that read the normalised inputs, each with the column where these begin in its
                input. Their weights are rescaled so that their outputs do not change.
        """
        real = values[mask].reshape(-1, values.shape[-1]).double()
        std = real.std(dim=0, correction=0)
        deviation = torch.where(std < MIN_DEVIATION, 1.0, std).float()
        mean = real.mean(dim=0).float()
        for layer, column in first_layers:
            weight = layer.weight[:, column : column + len(mean)]
            layer.bias.add_(weight @ ((mean - self.mean) / self.deviation))
            weight.mul_(deviation / self.deviation)
        self.mean.copy_(mean)
        self.deviation.copy_(deviation)

    def forward(self, values: Tensor) -> Tensor:
        """Normalise `values` (..., X)."""
        return ((values - self.mean) / self.deviation).clamp(-INPUT_LIMIT, INPUT_LIMIT)


def full_precision(x: Tensor) -> AbstractContextManager[object]:
    """Context without autocast on the device of `x`.

    A score is a mean over hundreds of rewards and a preference the difference of two scores: the three digits of
    bfloat16 are not enough for the last layers.
    """
    return torch.autocast(x.device.type, enabled=False)


def autocast(dtype: torch.dtype, device: torch.device) -> AbstractContextManager[object]:
    """Context in which layers multiply in `dtype`; parameters, gradients and the optimiser stay float32."""
    return nullcontext() if dtype == torch.float32 else torch.autocast(device.type, dtype)


def float32_on_cpu(device: torch.device) -> AbstractContextManager[object]:
    """Context in which a CPU computes attention in float32 even within `autocast`.

    Over few agents or steps, bfloat16 attention takes 9% longer (a training step at d = 256), and its error in
    relabelled rewards is above 2% of their standard deviation.
    """
    return torch.autocast("cpu", enabled=False) if device.type == "cpu" else nullcontext()


class ScalarLinear(nn.Linear):
    """A linear map (..., D) -> (..., 1), always in float32."""

    def __init__(self, dim: int) -> None:
        super().__init__(dim, 1)

    def forward(self, input: Tensor) -> Tensor:
        with full_precision(input):
            return super().forward(input.float())


class RewardHead(nn.Module):
    """Individual rewards (S, T, N) from features h (S, T, N, 2d) that depend on the past."""

    #: the last layer
    reward: ScalarLinear


class LinearHead(RewardHead):
    """A reward for each agent from its own features (MAPT-CPA and the baselines)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.reward = ScalarLinear(dim)

    def forward(self, h: Tensor) -> Tensor:
        """h (S, T, N, 2d) -> (S, T, N)."""
        return self.reward(h).squeeze(-1)


class MarkovPath(nn.Module):
    """A perceptron that rewards each agent for its present step alone: (S, T, N, C + A) -> (S, T, N)."""

    def __init__(self, dim: int, hidden_dim: int) -> None:
        super().__init__()
        self.first = nn.Linear(dim, hidden_dim)
        self.second = nn.Linear(hidden_dim, hidden_dim)
        self.reward = ScalarLinear(hidden_dim)

    @classmethod
    def of(cls, config: RewardConfig) -> "MarkovPath | None":
        """The Markov path of a network with this config, if it has one."""
        if not config.markov_path:
            return None
        return cls(config.observation_dim + config.action_dim, config.markov_dim or config.hidden_dim)

    def forward(self, inputs: Tensor) -> Tensor:
        return self.reward(F.gelu(self.second(F.gelu(self.first(inputs))))).squeeze(-1)


class LocalAttention(ABC):
    """Causal attention over a bounded past, in place of a whole segment's."""

    @property
    def context_steps(self) -> int:
        """K, leading steps that serve as keys and values only: the output begins after them."""
        return 0

    @abstractmethod
    def positions(self, n_steps: int) -> Tensor:
        """Positions of T steps for the rotary embedding, float64 (T,); only differences matter."""

    @abstractmethod
    def attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attention of each step over its past, (S, T - K, G, X); the G groups (agents times heads) are independent.

        Args:
            query: (S, T - K, G, X).
            key, value: (S, T, G, X).
        """


def drop_context(steps: Tensor, local: LocalAttention | None) -> Tensor:
    """`steps` (S, T, ...) without the K steps of context: (S, T - K, ...)."""
    return steps if local is None else steps[:, local.context_steps :]


class AgentAttention(nn.Module):
    """Multi-head self-attention among the N agents of each step."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(dim, dim)
        self.key = nn.Linear(dim, dim)
        self.value = nn.Linear(dim, dim)
        self.out = zero_init(nn.Linear(dim, dim))

    def forward(self, x: Tensor) -> Tensor:
        """Attend over the agents of `x` (S, T, N, d)."""
        s, t, n, d = x.shape
        query, key, value = (
            attention_input(part).reshape(s * t, n, self.heads, d // self.heads).transpose(1, 2)
            for part in joint_linear(x, self.query, self.key, self.value)
        )
        with float32_on_cpu(x.device):
            attended = F.scaled_dot_product_attention(query, key, value)
        return self.out(attended.transpose(1, 2).reshape(s, t, n, d))


class CausalAttention(nn.Module):
    """Multi-head self-attention of each agent over its own past, with rotary (relative) positions."""

    def __init__(self, dim: int, inner_dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.head_dim = inner_dim // heads
        self.query = nn.Linear(dim, inner_dim)
        self.key = nn.Linear(dim, inner_dim)
        self.value = nn.Linear(dim, inner_dim)
        self.out = zero_init(nn.Linear(inner_dim, dim))

    def forward(self, x: Tensor, local: LocalAttention | None = None) -> Tensor:
        """Attend over the steps of `x` (S, T, N, D): each sees itself and its past, or the part that `local` allows.

        Returns:
            (S, T, N, D), or (S, T - K, N, D) with K steps of context.
        """
        s, t, n, _ = x.shape
        context = 0 if local is None else local.context_steps
        if context:
            # A bfloat16 product over a slice with gaps in memory takes one product for each segment, at half the speed.
            parts = self.query(x[:, context:].contiguous()), *joint_linear(x, self.key, self.value)
        else:
            parts = joint_linear(x, self.query, self.key, self.value)
        # Agents and heads share one axis of independent groups.
        query, key, value = (
            attention_input(part).reshape(s, part.shape[1], n * self.heads, self.head_dim) for part in parts
        )
        positions = torch.arange(t, dtype=torch.float64) if local is None else local.positions(t)
        cosine, sine = rotary_embedding(positions, self.head_dim, x.device)
        # The rotation is float32; attention needs one dtype for all three.
        query = rotate(query, cosine[context:], sine[context:]).to(value.dtype)
        key = rotate(key, cosine, sine).to(value.dtype)
        with float32_on_cpu(x.device):
            attended = causal_attention(query, key, value) if local is None else local.attend(query, key, value)
        return self.out(attended.reshape(s, t - context, n, self.heads * self.head_dim))


def joint_linear(x: Tensor, *layers: nn.Linear) -> tuple[Tensor, ...]:
    """The outputs of several layers for one input, from one product.

    The input is read and converted to bfloat16 once, and so is the sum of its gradients.
    """
    weight = torch.cat([layer.weight for layer in layers])
    bias = torch.cat([layer.bias for layer in layers])
    return F.linear(x, weight, bias).split([layer.out_features for layer in layers], dim=-1)


def attention_input(x: Tensor) -> Tensor:
    """`x` in the dtype in which attention is computed; see `float32_on_cpu`."""
    return x.float() if x.device.type == "cpu" else x


def causal_attention(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Attention of each step over itself and all earlier steps, (S, T, G, X)."""
    query, key, value = (part.transpose(1, 2) for part in (query, key, value))
    return F.scaled_dot_product_attention(query, key, value, is_causal=True).transpose(1, 2)


def rotary_embedding(positions: Tensor, head_dim: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Cosine and sine (T, 1, head_dim / 2) of the rotation at each of `positions`, float64 (T,).

    Angles are float64: at step 1,000 a float32 angle is off by 1e-4.
    """
    frequency = ROTARY_BASE ** -(torch.arange(0, head_dim, 2, dtype=torch.float64) / head_dim)
    angle = positions[:, None, None] * frequency
    return angle.cos().float().to(device), angle.sin().float().to(device)


def rotate(x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Rotate the pairs (first half, second half) of `x` (S, T, G, X) by the angle of each step."""
    first, second = x.chunk(2, dim=-1)
    return torch.cat((first * cosine - second * sine, first * sine + second * cosine), dim=-1)


class FeedForward(nn.Module):
    """Two linear layers with a GELU between them, on the last dimension."""

    def __init__(self, dim: int, inner_dim: int) -> None:
        super().__init__()
        self.inner = nn.Linear(dim, inner_dim)
        self.out = zero_init(nn.Linear(inner_dim, dim))

    def forward(self, x: Tensor) -> Tensor:
        return self.out(F.gelu(self.inner(x)))


class SegmentDropout(nn.Module):
    """Dropout of whole features: one draw for all steps and agents of a segment.

    A score is a mean over steps and agents, which independent draws would leave nearly unchanged.
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


class TemporalBlock(nn.Module):
    """A pre-norm transformer block over the steps of h (S, T, N, 2d): causal attention, then a feed-forward layer."""

    def __init__(self, config: RewardConfig) -> None:
        super().__init__()
        width, d = 2 * config.hidden_dim, config.hidden_dim
        self.attention_norm = nn.LayerNorm(width)
        self.attention = CausalAttention(width, d, config.heads)
        self.feed_forward_norm = nn.LayerNorm(width)
        self.feed_forward = FeedForward(width, d)
        self.dropout = SegmentDropout(config.dropout)

    def forward(self, h: Tensor, local: LocalAttention | None = None) -> Tensor:
        attended = self.attention(self.attention_norm(h), local)
        h = drop_context(h, local) + self.dropout(attended)
        return h + self.dropout(self.feed_forward(self.feed_forward_norm(h)))


class TemporalLSTM(nn.Module):
    """An LSTM over the steps of each agent of h (S, T, N, 2d), in place of the attention (MAPT*)."""

    def __init__(self, config: RewardConfig) -> None:
        super().__init__()
        width, d = 2 * config.hidden_dim, config.hidden_dim
        self.norm = nn.LayerNorm(width)
        self.lstm = nn.LSTM(width, d, num_layers=config.layers, batch_first=True)
        self.out = zero_init(nn.Linear(d, width))
        self.dropout = SegmentDropout(config.dropout)

    def forward(self, h: Tensor) -> Tensor:
        s, t, n, width = h.shape
        by_agent = self.norm(h).transpose(1, 2).reshape(s * n, t, width)
        hidden, _ = self.lstm(by_agent)
        hidden = self.out(hidden).view(s, n, t, width).transpose(1, 2)
        return h + self.dropout(hidden)


class TemporalEncoder(nn.Module):
    """Encodes the past of each agent into every step of h (S, T, N, 2d), as `config.temporal` says.

    A `LocalAttention` with context, or a `KVCache`, serves one layer of attention at most.
    """

    def __init__(self, config: RewardConfig) -> None:
        super().__init__()
        self.blocks = nn.ModuleList()
        self.lstm = TemporalLSTM(config) if config.temporal == "lstm" else None
        if config.temporal == "attention":
            self.blocks.extend(TemporalBlock(config) for _ in range(config.layers))

    def forward(self, h: Tensor, local: LocalAttention | None = None) -> Tensor:
        if self.lstm is not None:
            return drop_context(self.lstm(h), local)
        for block in self.blocks:
            h = block(h, local)
        return h if self.blocks else drop_context(h, local)


def equal_weights(mask: Tensor) -> Tensor:
    """Weights (S, T) that are equal for the real steps of `mask` (S, T) and sum to 1."""
    real = mask.float()
    return real / real.sum(dim=1, keepdim=True)


def mean_attention(attention: Tensor, mask: Tensor) -> Tensor:
    """Weights (S, T) of steps: attention weights (S, query step, key step) averaged over the real queries of `mask`."""
    real = mask.to(attention.dtype)
    return (attention * real[..., None]).sum(dim=1) / real.sum(dim=1, keepdim=True)


def zero_init(layer: nn.Linear) -> nn.Linear:
    """`layer` with its weights and bias set to zero."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
