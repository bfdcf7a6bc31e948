"""In which precision the products of a network are taken."""

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from mapt.errors import InvalidConfig
from mapt.rewards.config import Precision

# From this d on, products take so much of a training step that halving their numbers pays for the conversions.
LEAST_BFLOAT16_DIM = 128


def resolve_precision(name: str, hidden_dim: int, device: torch.device) -> torch.dtype:
    """The type in which products are taken; "auto" is bfloat16 where the machine multiplies it and d is large enough.

    Raises:
        InvalidConfig: if there is no such precision.
    """
    if name not in get_args(Precision):
        raise InvalidConfig(f"precision is {name!r}; known: {', '.join(get_args(Precision))}")
    if name == "auto":
        pays = hidden_dim >= LEAST_BFLOAT16_DIM and multiplies_bfloat16(device)
        return torch.bfloat16 if pays else torch.float32
    return torch.bfloat16 if name == "bfloat16" else torch.float32


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether the device has instructions for products of bfloat16."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and torch.ops.mkldnn._is_mkldnn_bf16_supported()


def products_in(dtype: torch.dtype, device: torch.device) -> AbstractContextManager[object]:
    """Within it, layers multiply in `dtype`; parameters, their gradients and the optimiser stay float32.

    Go through it forwards only, once a step, and leave it before the loss: the backward pass follows by itself.
    """
    if dtype == torch.float32:
        return nullcontext()
    return torch.autocast(device.type, dtype)


def small_products(device: torch.device) -> AbstractContextManager[object]:
    """Within it, products on a CPU are float32 again, whatever is around it.

    An attention over few agents or steps is thousands of tiny products; each conversion to bfloat16 costs more than
    it saves, and the backward pass of such an attention took three times as long.
    """
    return torch.autocast("cpu", enabled=False) if device.type == "cpu" else nullcontext()


# Episode numbers of the filler around a rollout: equal to no real one, nor to each other.
_FILLER_BEFORE = -2
_FILLER_AFTER = -3
# Fewest queries that are worth a block of their own.
_SMALLEST_BLOCK = 16


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


@dataclass(frozen=True, slots=True)
class EpisodeBand(Band):
    """The past of each step of a rollout: its own episode, `window` steps with itself."""

    window: int
    #: int64 (S, T), equal for steps of one episode; never below -1
    episode: Tensor
    #: see `Band.context_steps`
    context: int = 0

    @property
    def context_steps(self) -> int:
        """See `Band`."""
        return self.context

    def positions(self, n_steps: int) -> Tensor:
        """See `Band`."""
        return torch.arange(n_steps, dtype=torch.float64)

    def attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """See `Band`; its cost is linear in T.

        Queries go in blocks of one window; the keys of a block are its own steps and the window - 1 before.
        """
        s, t, g, x = query.shape
        block = max(self.window, _SMALLEST_BLOCK)
        before, after = self.window - 1, -t % block
        n_blocks, span = (t + after) // block, block + before
        # Context beyond the window is cut off, what a window lacks of it filled.
        filler = before - self.context, after

        def blocks_of_keys(steps: Tensor) -> Tensor:
            padded = F.pad(steps, (0, 0, 0, 0, *filler))
            unfolded = padded.unfold(1, span, block)  # (S, blocks, G, X, span)
            return unfolded.permute(0, 1, 2, 4, 3).reshape(s * n_blocks, g, span, x)

        queries = F.pad(query, (0, 0, 0, 0, 0, after)).view(s * n_blocks, block, g, x).transpose(1, 2)
        visible = self._visible(filler, block, span).flatten(0, 1)[:, None]
        mixed = F.scaled_dot_product_attention(queries, blocks_of_keys(key), blocks_of_keys(value), attn_mask=visible)
        return mixed.transpose(1, 2).reshape(s, n_blocks * block, g, x)[:, :t]

    def _visible(self, filler: tuple[int, int], block: int, span: int) -> Tensor:
        """Bool (S, blocks, block, span): may this query see this key?"""
        before, after = filler
        known = F.pad(self.episode, (0, after), value=_FILLER_AFTER)
        asked = F.pad(known, (before, 0), value=_FILLER_BEFORE).unfold(1, span, block)
        asking = known[:, self.context :].unflatten(1, (-1, block))
        steps = torch.arange(span, device=asking.device)
        age = steps[:block, None] + (self.window - 1) - steps
        return (asking[..., None] == asked[:, :, None]) & (age >= 0) & (age < self.window)


class KeyValueRing(Band):
    """The past of the one step that comes next: keys and values of the last `window` steps, itself included.

    Every call of `attend` is one step further, for one attention layer. Keys keep the rotation of the step they
    came at: rotations are relative, so none is turned again as it ages, and the ring's order does not matter.
    """

    def __init__(self, window: int, n_envs: int, device: torch.device) -> None:
        self._window = window
        self._n_steps = 0
        self._keys = self._values = torch.empty(0, device=device)
        #: added to the logits (E, 1, 1, T): 0 where a place holds a step of the running episode, else -inf
        self._bias = torch.full((n_envs, 1, 1, window), float("-inf"), device=device)

    def forget(self, envs: Tensor) -> None:
        """Begin a new episode where `envs`, bool (E,), is true."""
        self._bias.masked_fill_(envs[:, None, None, None], float("-inf"))

    def positions(self, n_steps: int) -> Tensor:
        """See `Band`; `n_steps` is 1."""
        return torch.full((n_steps,), self._n_steps, dtype=torch.float64)

    def attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """See `Band`; (E, 1, G, X)."""
        e, _, g, x = query.shape
        if not self._keys.numel():
            self._keys, self._values = (key.new_zeros(e, g, self._window, x) for _ in range(2))
        place = self._n_steps % self._window
        self._keys[:, :, place] = key[:, 0]
        self._values[:, :, place] = value[:, 0]
        self._bias[..., place] = 0.0
        self._n_steps += 1
        mixed = F.scaled_dot_product_attention(query.transpose(1, 2), self._keys, self._values, attn_mask=self._bias)
        return mixed.transpose(1, 2)
