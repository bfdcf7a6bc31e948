"""The past as a rollout has it: episodes behind each other, or one step at a time."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from mapt.rewards.attention import Band

# Episode numbers of the filler around a rollout: equal to no real one, nor to each other.
_FILLER_BEFORE = -2
_FILLER_AFTER = -3
# Fewest queries that are worth a block of their own.
_SMALLEST_BLOCK = 16


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
