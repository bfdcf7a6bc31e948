"""Faster ways to compute what the plain network computes, each with the benchmark that justifies it.

A training step in float32 uses none of them.

- `BandedAttention` relabels a rollout in one pass; the plain way runs the network on each step's window, which takes
  about T times as long (`bench_rewards.py --rows relabelling`).
- `KVCache` computes one step in a stream of steps; the plain way runs the whole window for each step, about T times
  the work (`bench_rewards.py --rows streaming`).
- `resolve_precision` chooses bfloat16 products where the processor has them: a training step at d = 256 takes 7.8 s of
  CPU time instead of 14.9 s (`bench_rewards.py --rows training --sizes paper`).
"""

from dataclasses import dataclass
from typing import get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from mapt.errors import InvalidConfig
from mapt.rewards.config import Precision
from mapt.rewards.layers import LocalAttention

# Below this d, converting to bfloat16 costs as much as the faster products save.
MIN_BFLOAT16_DIM = 128
# Episode numbers of the padding around a rollout: they differ from every real number and from each other.
_PADDING_BEFORE = -2
_PADDING_AFTER = -3
# Blocks of fewer queries than this spend their time on padding.
_MIN_BLOCK = 16


def resolve_precision(name: str, hidden_dim: int, device: torch.device) -> torch.dtype:
    """The dtype of matrix products; "auto" is bfloat16 where the hardware multiplies it and d is large enough.

    Raises:
        InvalidConfig: if the name is unknown.
    """
    if name not in get_args(Precision):
        raise InvalidConfig(f"precision is {name!r}; it must be one of {', '.join(get_args(Precision))}.", "precision")
    if name == "auto":
        use_bfloat16 = hidden_dim >= MIN_BFLOAT16_DIM and supports_bfloat16(device)
        return torch.bfloat16 if use_bfloat16 else torch.float32
    return torch.bfloat16 if name == "bfloat16" else torch.float32


def supports_bfloat16(device: torch.device) -> bool:
    """Whether the device has instructions for bfloat16 products."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # There is no public function for this.
    return device.type == "cpu" and torch.ops.mkldnn._is_mkldnn_bf16_supported()


@dataclass(frozen=True, slots=True)
class BandedAttention(LocalAttention):
    """Attention of each step of a rollout over the last `window` steps of its episode, including itself.

    Queries are grouped in blocks of one window; the keys of a block are its own steps and the window - 1 before it, so
    that the cost is linear in T.
    """

    window: int
    #: int64 (S, T), equal for the steps of one episode; -1 or more
    episode: Tensor
    #: see `LocalAttention.context_steps`
    context: int = 0

    @property
    def context_steps(self) -> int:
        """See `LocalAttention`."""
        return self.context

    def positions(self, n_steps: int) -> Tensor:
        """See `LocalAttention`."""
        return torch.arange(n_steps, dtype=torch.float64)

    def attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """See `LocalAttention`."""
        s, t, g, x = query.shape
        block = max(self.window, _MIN_BLOCK)
        before, after = self.window - 1, -t % block
        n_blocks, span = (t + after) // block, block + before
        # Negative padding cuts off context beyond the window.
        padding = before - self.context, after

        def key_blocks(steps: Tensor) -> Tensor:
            padded = F.pad(steps, (0, 0, 0, 0, *padding))
            unfolded = padded.unfold(1, span, block)  # (S, blocks, G, X, span)
            return unfolded.permute(0, 1, 2, 4, 3).reshape(s * n_blocks, g, span, x)

        queries = F.pad(query, (0, 0, 0, 0, 0, after)).view(s * n_blocks, block, g, x).transpose(1, 2)
        visible = self._visible(padding, block, span).flatten(0, 1)[:, None]
        attended = F.scaled_dot_product_attention(queries, key_blocks(key), key_blocks(value), attn_mask=visible)
        return attended.transpose(1, 2).reshape(s, n_blocks * block, g, x)[:, :t]

    def _visible(self, padding: tuple[int, int], block: int, span: int) -> Tensor:
        """Whether a query sees a key, bool (S, blocks, block, span)."""
        before, after = padding
        padded = F.pad(self.episode, (0, after), value=_PADDING_AFTER)
        key_episode = F.pad(padded, (before, 0), value=_PADDING_BEFORE).unfold(1, span, block)
        query_episode = padded[:, self.context :].unflatten(1, (-1, block))
        steps = torch.arange(span, device=padded.device)
        age = steps[:block, None] + (self.window - 1) - steps
        return (query_episode[..., None] == key_episode[:, :, None]) & (age >= 0) & (age < self.window)


class KVCache(LocalAttention):
    """Keys and values of the last `window` steps of E environments, for the attention of one layer, step by step.

    A ring buffer: each call of `attend` overwrites the oldest step. Keys keep the rotation of their own step, since
    rotary positions are relative, so the order in the buffer does not matter.
    """

    def __init__(self, window: int, n_envs: int, device: torch.device) -> None:
        self._window = window
        self._n_steps = 0
        self._keys = self._values = torch.empty(0, device=device)
        #: added to the logits, (E, 1, 1, T): 0 for steps of the running episode, else -inf
        self._bias = torch.full((n_envs, 1, 1, window), float("-inf"), device=device)

    def start_episode(self, envs: Tensor) -> None:
        """Hide all earlier steps of the environments where `envs`, bool (E,), is true."""
        self._bias.masked_fill_(envs[:, None, None, None], float("-inf"))

    def positions(self, n_steps: int) -> Tensor:
        """See `LocalAttention`; `n_steps` is 1."""
        return torch.full((n_steps,), self._n_steps, dtype=torch.float64)

    def attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """See `LocalAttention`; every tensor is (E, 1, G, X)."""
        e, _, g, x = query.shape
        if not self._keys.numel():
            self._keys, self._values = (key.new_zeros(e, g, self._window, x) for _ in range(2))
        slot = self._n_steps % self._window
        self._keys[:, :, slot] = key[:, 0]
        self._values[:, :, slot] = value[:, 0]
        self._bias[..., slot] = 0.0
        self._n_steps += 1
        attended = F.scaled_dot_product_attention(query.transpose(1, 2), self._keys, self._values, attn_mask=self._bias)
        return attended.transpose(1, 2)
