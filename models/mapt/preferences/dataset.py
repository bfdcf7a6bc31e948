"""Segments of trajectories, and datasets of labelled pairs of segments."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import (
    InvalidAgent,
    InvalidLabel,
    InvalidMask,
    InvalidPair,
    InvalidWeight,
    NotEnoughPairs,
    NotFinite,
    ShapeError,
)

FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

# Segments of the hold-out may be left out of the training if at least this fraction of its pairs remains.
MIN_SEPARATE_FRACTION = 0.5
#: In place of a decisive agent, where none was named.
NO_AGENT = -1


@dataclass(frozen=True, slots=True)
class SegmentArrays:
    """Observations and actions of S segments, padded at the end to T steps: the input of a reward model.

    Padding comes last, so that a causal model needs no mask to ignore it.

    Raises:
        ShapeError: if the shapes of the arrays disagree.
        NotFinite: if observations or actions hold NaN or infinity.
        InvalidMask: if a row of the mask is not one or more ones followed by zeros.
    """

    #: float32 (S, T, N, C)
    observations: FloatArray
    #: float32 (S, T, N, A), one-hot where actions are discrete
    actions: FloatArray
    #: bool (S, T), false in the padding
    mask: BoolArray

    def __post_init__(self) -> None:
        if self.observations.ndim != 4 or self.observations.shape[1] == 0:
            raise ShapeError("observations", self.observations.shape, "(S, T, N, C) with T >= 1")
        steps = self.observations.shape[:3]
        if self.actions.ndim != 4 or self.actions.shape[:3] != steps:
            raise ShapeError("actions", self.actions.shape, f"{(*steps, 'A')}")
        if self.mask.shape != steps[:2]:
            raise ShapeError("mask", self.mask.shape, f"{steps[:2]}")
        check_mask(self.mask)
        self._check_finite("observations", self.observations)
        self._check_finite("actions", self.actions)

    def _check_finite(self, name: str, values: FloatArray) -> None:
        invalid = ~np.isfinite(values).all(axis=(1, 2, 3))
        if invalid.any():
            raise NotFinite(name, int(invalid.argmax()))

    @classmethod
    def stack(cls, observations: Sequence[ArrayLike], actions: Sequence[ArrayLike]) -> "SegmentArrays":
        """Pad segments of different lengths with zeros to the longest.

        Args:
            observations, actions: of each segment, (T_s, N, C) and (T_s, N, A).

        Raises:
            ShapeError: if there is no segment, or a segment differs from the first in agents or dimensions.
        """
        if not observations or len(observations) != len(actions):
            raise ShapeError("segments", (len(observations), len(actions)), "as many actions, at least one")
        padded_observations, lengths = pad("observations", [np.asarray(each, np.float32) for each in observations])
        padded_actions, action_lengths = pad("actions", [np.asarray(each, np.float32) for each in actions])
        if padded_observations.ndim != 4:
            raise ShapeError("observations", padded_observations.shape[1:], "(T, N, C)")
        if (lengths != action_lengths).any():
            raise ShapeError(
                "actions", tuple(action_lengths.tolist()), f"the steps of observations, {lengths.tolist()}"
            )
        return cls(padded_observations, padded_actions, length_mask(lengths))

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


def pad(name: str, arrays: Sequence[NDArray[Any]]) -> tuple[NDArray[Any], IntArray]:
    """Pad arrays (T_s, ...) with zeros to the longest, in the dtype of the first.

    Args:
        name: what the arrays are called in an error.

    Returns:
        The padded arrays, (S, T, ...), and the length of each, int64 (S,).

    Raises:
        ShapeError: if an array has no steps axis, or differs from the first in another axis.
    """
    trailing = arrays[0].shape[1:]
    for array in arrays:
        if not array.ndim or array.shape[1:] != trailing:
            raise ShapeError(name, array.shape, f"({', '.join(map(str, ('T', *trailing)))})")
    lengths = np.array([len(array) for array in arrays])
    padded = np.zeros((len(arrays), lengths.max(), *trailing), dtype=arrays[0].dtype)
    for row, array in zip(padded, arrays, strict=True):
        row[: len(array)] = array
    return padded, lengths


def length_mask(lengths: IntArray) -> BoolArray:
    """The mask (S, T) of segments of these lengths (S,), T the longest."""
    return np.arange(lengths.max()) < lengths[:, None]


def check_mask(mask: BoolArray) -> None:
    """Raise InvalidMask unless each row of a mask (S, T) is one or more ones followed by zeros."""
    invalid = ~mask[:, 0] | (mask[:, 1:] & ~mask[:, :-1]).any(axis=1)
    if invalid.any():
        raise InvalidMask(int(invalid.argmax()))


class SegmentSource(Protocol):
    """S segments of equal dimensions, read by index: `SegmentArrays` in memory, `SegmentFolder` on disk."""

    def __len__(self) -> int: ...

    @property
    def n_steps(self) -> int:
        """T, to which segments are padded."""
        ...

    @property
    def n_agents(self) -> int: ...

    @property
    def observation_dim(self) -> int: ...

    @property
    def action_dim(self) -> int: ...

    def take(self, indices: ArrayLike) -> SegmentArrays:
        """The segments at `indices`, int (B,) in [0, S), in that order. Indices may repeat."""
        ...


def in_batches(segments: SegmentSource, size: int) -> Iterator[SegmentArrays]:
    """Yield all segments in order, `size` at a time, holding one batch in memory."""
    for first in range(0, len(segments), size):
        yield segments.take(np.arange(first, min(first + size, len(segments))))


@dataclass(frozen=True, slots=True)
class PreferenceDataset:
    """Labelled pairs of segments, without skipped pairs.

    Raises:
        ShapeError: if `pairs`, `labels`, `ids`, `weights` or `decisive_agents` has the wrong shape.
        InvalidPair, InvalidLabel, InvalidWeight, InvalidAgent: for the first pair that refers to a missing segment, or
            has an invalid label, weight or decisive agent.
    """

    #: in memory or on disk; several pairs may share a segment
    segments: SegmentSource
    #: int (P, 2), indices into `segments`: (segment 0, segment 1)
    pairs: IntArray
    #: float32 (P,), P(segment 0 preferred)
    labels: FloatArray
    #: int (P,), a number for each pair that never changes, such as its query's; by default its index
    ids: IntArray = None  # pyright: ignore[reportAssignmentType]  (set by __post_init__)
    #: float32 (P,) in [0, 1], the weight of each label; see `preference_losses`. By default 1
    weights: FloatArray = None  # pyright: ignore[reportAssignmentType]  (set by __post_init__)
    #: int (P,), the agent that decided each label, in [0, N), or `NO_AGENT`; see `decisive_agent_losses`. By default
    #: none was named
    decisive_agents: IntArray = None  # pyright: ignore[reportAssignmentType]  (set by __post_init__)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pairs", np.asarray(self.pairs, dtype=np.int64))
        object.__setattr__(self, "labels", np.asarray(self.labels, dtype=np.float32))
        if self.pairs.ndim != 2 or self.pairs.shape[1] != 2:
            raise ShapeError("pairs", self.pairs.shape, "(P, 2)")
        if self.labels.shape != self.pairs.shape[:1]:
            raise ShapeError("labels", self.labels.shape, f"{self.pairs.shape[:1]}")
        ids = np.arange(len(self.pairs)) if self.ids is None else np.asarray(self.ids, dtype=np.int64)
        if ids.shape != self.labels.shape:
            raise ShapeError("ids", ids.shape, f"{self.labels.shape}")
        object.__setattr__(self, "ids", ids)
        weights = np.ones_like(self.labels) if self.weights is None else np.asarray(self.weights, dtype=np.float32)
        if weights.shape != self.labels.shape:
            raise ShapeError("weights", weights.shape, f"{self.labels.shape}")
        object.__setattr__(self, "weights", weights)
        agents = np.full_like(ids, NO_AGENT)
        if self.decisive_agents is not None:
            agents = np.asarray(self.decisive_agents, dtype=np.int64)
        if agents.shape != self.labels.shape:
            raise ShapeError("decisive_agents", agents.shape, f"{self.labels.shape}")
        object.__setattr__(self, "decisive_agents", agents)
        n_segments = len(self.segments)
        invalid = ((self.pairs < 0) | (self.pairs >= n_segments)).any(axis=1)
        invalid |= self.pairs[:, 0] == self.pairs[:, 1]
        if invalid.any():
            index = int(invalid.argmax())
            first, second = self.pairs[index].tolist()
            raise InvalidPair(index, (first, second), n_segments)
        invalid = ~((self.labels >= 0) & (self.labels <= 1))
        if invalid.any():
            raise InvalidLabel(int(invalid.argmax()), float(self.labels[invalid.argmax()]))
        invalid = ~((self.weights >= 0) & (self.weights <= 1))
        if invalid.any():
            raise InvalidWeight(int(invalid.argmax()), float(self.weights[invalid.argmax()]))
        invalid = (agents < NO_AGENT) | (agents >= self.segments.n_agents)
        if invalid.any():
            raise InvalidAgent(int(invalid.argmax()), int(agents[invalid.argmax()]), self.segments.n_agents)

    def __len__(self) -> int:
        return len(self.pairs)

    def take(self, indices: ArrayLike) -> "PreferenceDataset":
        """The pairs at `indices`; the segments are shared, not copied."""
        index = np.asarray(indices)
        return PreferenceDataset(
            self.segments,
            self.pairs[index],
            self.labels[index],
            self.ids[index],
            self.weights[index],
            self.decisive_agents[index],
        )

    def weighted(self, weights: ArrayLike) -> "PreferenceDataset":
        """The same pairs with other weights, (P,)."""
        return replace(self, weights=np.asarray(weights, np.float32))

    def joined(self, other: "PreferenceDataset") -> "PreferenceDataset":
        """These pairs followed by those of `other`, which has the same segments."""
        return PreferenceDataset(
            self.segments,
            np.concatenate((self.pairs, other.pairs)),
            np.concatenate((self.labels, other.labels)),
            np.concatenate((self.ids, other.ids)),
            np.concatenate((self.weights, other.weights)),
            np.concatenate((self.decisive_agents, other.decisive_agents)),
        )

    def held_out(self, fraction: float, seed: int) -> BoolArray:
        """Whether each pair is held out, bool (P,): the hash of its id decides.

        A pair keeps its side whatever labels are added, changed or undone, so that a model that continues from an
        earlier one has never been trained on a hold-out pair.

        Raises:
            NotEnoughPairs: if there are fewer than two pairs.
        """
        if len(self) < 2:
            raise NotEnoughPairs(len(self), 2)
        held_out = _uniform_hash(self.ids, 2 * seed) < fraction
        # A few pairs may all be on one side; without pairs to train on, none is held out.
        return held_out & ~held_out.all()

    def folds(self, n_folds: int, seed: int) -> IntArray:
        """Fold of each pair by the hash of its id, int (P,) in [0, `n_folds`), independent of `held_out`."""
        return (_uniform_hash(self.ids, 2 * seed + 1) * n_folds).astype(np.int64)

    def separate(self, held_out: BoolArray) -> tuple["PreferenceDataset", "PreferenceDataset"]:
        """The pairs to train on, and those of `held_out`, bool (P,).

        Pairs that share a segment with a held-out pair are left out of the training, or the hold-out would be
        optimistic. If this left fewer than `MIN_SEPARATE_FRACTION` of the pairs to train on, all are kept.
        """
        shares = np.isin(self.pairs, self.pairs[held_out]).any(axis=1)
        enough = (~shares).sum() >= MIN_SEPARATE_FRACTION * (~held_out).sum()
        return self.take(np.flatnonzero(~shares if enough else ~held_out)), self.take(np.flatnonzero(held_out))

    def split(self, hold_out_fraction: float, seed: int) -> tuple["PreferenceDataset", "PreferenceDataset"]:
        """Split the pairs into (train, hold-out); see `held_out` and `separate`.

        Raises:
            NotEnoughPairs: if there are fewer than two pairs.
        """
        return self.separate(self.held_out(hold_out_fraction, seed))


def _uniform_hash(ids: IntArray, salt: int) -> NDArray[np.float64]:
    """A number in [0, 1) for each id and salt, the same on every machine (SplitMix64; Steele et al., 2014)."""
    # Arrays of uint64 wrap around on overflow, as the algorithm wants.
    x = ids.astype(np.uint64) + np.full(1, salt, np.uint64) * np.uint64(0xD1342543DE82EF95)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = x + np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)
    return ((x ^ (x >> np.uint64(31))) >> np.uint64(11)).astype(np.float64) * 2.0**-53
