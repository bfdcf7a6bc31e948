"""Segments stored once, and the labelled pairs that point at them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import InvalidLabel, InvalidMask, InvalidPair, NotEnoughPairs, NotFinite, ShapeError

FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class SegmentArrays:
    """What a reward model sees of S segments.

    Real steps come first and padding after them, so that a causal model needs no mask to ignore it.

    Raises:
        ShapeError, NotFinite, InvalidMask: where the arrays disagree or hold what cannot be learned from.
    """

    #: float32 (S, T, N, C)
    observations: FloatArray
    #: float32 (S, T, N, A), one-hot where actions are discrete
    actions: FloatArray
    #: bool (S, T), true where the step is real
    mask: BoolArray

    def __post_init__(self) -> None:
        if self.observations.ndim != 4 or self.observations.shape[1] == 0:
            raise ShapeError("observations", self.observations.shape, "(S, T, N, C) with T >= 1")
        steps = self.observations.shape[:3]
        if self.actions.ndim != 4 or self.actions.shape[:3] != steps:
            raise ShapeError("actions", self.actions.shape, f"{(*steps, 'A')}")
        if self.mask.shape != steps[:2]:
            raise ShapeError("mask", self.mask.shape, f"{steps[:2]}")
        self._check_mask()
        self._check_finite("observations", self.observations)
        self._check_finite("actions", self.actions)

    def _check_mask(self) -> None:
        broken = ~self.mask[:, 0] | (self.mask[:, 1:] & ~self.mask[:, :-1]).any(axis=1)
        if broken.any():
            raise InvalidMask(int(broken.argmax()))

    def _check_finite(self, name: str, values: FloatArray) -> None:
        broken = ~np.isfinite(values).all(axis=(1, 2, 3))
        if broken.any():
            raise NotFinite(name, int(broken.argmax()))

    @classmethod
    def stack(cls, observations: Sequence[ArrayLike], actions: Sequence[ArrayLike]) -> "SegmentArrays":
        """Pad segments (T_s, N, C) and (T_s, N, A) of any lengths with zeros to the longest.

        Raises:
            ShapeError: if there is no segment, or one differs from the first in agents or dimensions.
        """
        if not observations or len(observations) != len(actions):
            raise ShapeError("segments", (len(observations), len(actions)), "as many actions, at least one")
        observed, n_steps = _pad("observations", observations)
        acted, action_steps = _pad("actions", actions)
        if n_steps != action_steps:
            raise ShapeError("actions", tuple(action_steps), f"the steps of observations, {tuple(n_steps)}")
        mask = np.arange(observed.shape[1])[None] < np.asarray(n_steps)[:, None]
        return cls(observed, acted, mask)

    def __len__(self) -> int:
        return len(self.observations)

    @property
    def n_steps(self) -> int:
        return self.observations.shape[1]

    @property
    def n_agents(self) -> int:
        return self.observations.shape[2]

    @property
    def observation_dim(self) -> int:
        return self.observations.shape[3]

    @property
    def action_dim(self) -> int:
        return self.actions.shape[3]

    def take(self, indices: ArrayLike) -> "SegmentArrays":
        """The segments at `indices`, in that order."""
        index = np.asarray(indices)
        return SegmentArrays(self.observations[index], self.actions[index], self.mask[index])


def _pad(name: str, parts: Sequence[ArrayLike]) -> tuple[FloatArray, list[int]]:
    arrays = [np.asarray(part, dtype=np.float32) for part in parts]
    for array in arrays:
        if array.ndim != 3 or array.shape[1:] != arrays[0].shape[1:]:
            raise ShapeError(name, array.shape, f"(T, {', '.join(map(str, arrays[0].shape[1:]))})")
    n_steps = [len(array) for array in arrays]
    padded = np.zeros((len(arrays), max(n_steps), *arrays[0].shape[1:]), dtype=np.float32)
    for row, array in zip(padded, arrays, strict=True):
        row[: len(array)] = array
    return padded, n_steps


class SegmentSource(Protocol):
    """S segments of equal dimensions, read by index: `SegmentArrays` in memory, `SegmentFolder` on disk.

    Whatever asks for a batch of segments at a time, and never for all of them, works on either.
    """

    def __len__(self) -> int: ...

    @property
    def n_steps(self) -> int:
        """T, the longest a segment can be."""
        ...

    @property
    def n_agents(self) -> int: ...

    @property
    def observation_dim(self) -> int: ...

    @property
    def action_dim(self) -> int: ...

    def take(self, indices: ArrayLike) -> SegmentArrays:
        """The segments at `indices`, int (B,) in [0, S), in that order; one named twice comes twice."""
        ...


def in_batches(segments: SegmentSource, size: int) -> Iterator[SegmentArrays]:
    """All the segments in order, `size` at a time: one pass in the memory of one batch."""
    for first in range(0, len(segments), size):
        yield segments.take(np.arange(first, min(first + size, len(segments))))


@dataclass(frozen=True, slots=True)
class PreferenceDataset:
    """Labelled pairs of segments.

    A skipped pair (a teacher's NaN) has no place here: drop it before.

    Raises:
        ShapeError, InvalidPair, InvalidLabel: naming the first pair that is wrong.
    """

    #: in memory or on disk
    segments: SegmentSource
    #: int (P, 2), indices into `segments`: (segment 0, segment 1)
    pairs: IntArray
    #: float32 (P,), P(segment 0 preferred)
    labels: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "pairs", np.asarray(self.pairs, dtype=np.int64))
        object.__setattr__(self, "labels", np.asarray(self.labels, dtype=np.float32))
        if self.pairs.ndim != 2 or self.pairs.shape[1] != 2:
            raise ShapeError("pairs", self.pairs.shape, "(P, 2)")
        if self.labels.shape != self.pairs.shape[:1]:
            raise ShapeError("labels", self.labels.shape, f"{self.pairs.shape[:1]}")
        n_segments = len(self.segments)
        wrong = ((self.pairs < 0) | (self.pairs >= n_segments)).any(axis=1)
        wrong |= self.pairs[:, 0] == self.pairs[:, 1]
        if wrong.any():
            index = int(wrong.argmax())
            first, second = self.pairs[index].tolist()
            raise InvalidPair(index, (first, second), n_segments)
        wrong = ~((self.labels >= 0) & (self.labels <= 1))
        if wrong.any():
            raise InvalidLabel(int(wrong.argmax()), float(self.labels[wrong.argmax()]))

    def __len__(self) -> int:
        return len(self.pairs)

    def take(self, indices: ArrayLike) -> "PreferenceDataset":
        """The pairs at `indices`; the segments are shared, not copied."""
        index = np.asarray(indices)
        return PreferenceDataset(self.segments, self.pairs[index], self.labels[index])

    def split(self, hold_out_fraction: float, seed: int) -> tuple["PreferenceDataset", "PreferenceDataset"]:
        """Split by pair into (train, hold-out).

        One pair is held out at random of every run of 1 / `hold_out_fraction` successive pairs. When pairs
        are appended later, every earlier pair stays on its side: a model warm-started from a version
        trained on fewer pairs has then never seen its hold-out.

        Raises:
            NotEnoughPairs: with fewer than two pairs.
        """
        if len(self) < 2:
            raise NotEnoughPairs(len(self), 2)
        held_out = _held_out(len(self), hold_out_fraction, seed)
        return self.take(np.flatnonzero(~held_out)), self.take(np.flatnonzero(held_out))


def _held_out(n_pairs: int, fraction: float, seed: int) -> BoolArray:
    stratum = np.floor(np.arange(n_pairs) * fraction + 1e-9).astype(np.int64)
    n_strata = int(stratum[-1]) + 1
    first = np.ceil((np.arange(n_strata) - 1e-9) / fraction).astype(np.int64)
    size = np.ceil((np.arange(1, n_strata + 1) - 1e-9) / fraction).astype(np.int64) - first
    # One uniform draw per stratum, in order, does not depend on how many strata follow.
    chosen = first + (np.random.default_rng(seed).random(n_strata) * size).astype(np.int64)
    held_out = np.zeros(n_pairs, dtype=np.bool_)
    held_out[chosen[chosen < n_pairs]] = True
    return held_out
