"""What every format is turned into, and made from: segments with what is known of them, and comparisons."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import InvalidFile, ShapeError
from mapt.preferences.dataset import FloatArray, IntArray, PreferenceDataset, SegmentArrays, SegmentSource
from mapt.preferences.storage import SegmentFolder, SegmentLayout, SegmentWriter

#: P(segment 0 preferred), as every file of ours says it
POLARITY = "1: segment 0 is better; 0: segment 1 is better; 0.5: equal"


@dataclass(frozen=True, slots=True)
class SegmentRecords:
    """S segments; rewards and simulator states where they are known.

    Raises:
        ShapeError: if an array does not have the segments' (S, T).
    """

    segments: SegmentArrays
    #: true rewards, float64 (S, T)
    rewards: NDArray[np.float64] | None = None
    #: simulator states, float64 (S, T, nq) and (S, T, nv)
    qpos: NDArray[np.float64] | None = None
    qvel: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        steps = self.segments.mask.shape
        for name, n_dims in (("rewards", 2), ("qpos", 3), ("qvel", 3)):
            values = getattr(self, name)
            if values is not None and (values.ndim != n_dims or values.shape[:2] != steps):
                raise ShapeError(name, values.shape, f"({steps[0]}, {steps[1]}{', n' * (n_dims - 2)})")

    def __len__(self) -> int:
        return len(self.segments)

    @property
    def lengths(self) -> IntArray:
        """Real steps of each segment, (S,)."""
        return self.segments.mask.sum(axis=1)

    def take(self, indices: ArrayLike) -> "SegmentRecords":
        """The segments at `indices`, in that order."""
        index = np.asarray(indices)
        rest = {name: values[index] for name, values in self.extras().items()}
        return SegmentRecords(self.segments.take(index), **rest)

    def extras(self) -> dict[str, NDArray[np.float64]]:
        """rewards, qpos and qvel, those that are known."""
        named = {"rewards": self.rewards, "qpos": self.qpos, "qvel": self.qvel}
        return {name: values for name, values in named.items() if values is not None}

    def layout(self, *, discrete: bool = False) -> SegmentLayout:
        """How these would lie on disk."""
        segments = self.segments
        return SegmentLayout(
            segments.n_steps,
            segments.n_agents,
            segments.observation_dim,
            segments.action_dim,
            discrete=discrete,
            rewards=self.rewards is not None,
            qpos_dim=0 if self.qpos is None else self.qpos.shape[2],
            qvel_dim=0 if self.qvel is None else self.qvel.shape[2],
        )


@dataclass(frozen=True, slots=True)
class Comparisons:
    """P pairs of segments and what a teacher said of each."""

    records: SegmentRecords
    #: int64 (P, 2), indices into `records`: (segment 0, segment 1)
    pairs: IntArray
    #: float32 (P,), P(segment 0 preferred); NaN where the pair was skipped
    labels: FloatArray

    @classmethod
    def of_pairs(cls, first: SegmentRecords, second: SegmentRecords, labels: ArrayLike) -> "Comparisons":
        """Segment b of `first` against segment b of `second`.

        Raises:
            ShapeError: if the two have different dimensions.
        """
        n_pairs = len(first)
        pairs = np.arange(2 * n_pairs).reshape(2, n_pairs).T
        return cls(concatenate([first, second]), pairs, np.asarray(labels, dtype=np.float32))

    def __len__(self) -> int:
        return len(self.pairs)

    def dataset(self) -> PreferenceDataset:
        """To train on: without the skipped pairs.

        Raises:
            ShapeError, InvalidPair, InvalidLabel: naming the first pair that is wrong.
        """
        said = ~np.isnan(self.labels)
        return PreferenceDataset(self.records.segments, self.pairs[said], self.labels[said])


def concatenate(parts: list[SegmentRecords]) -> SegmentRecords:
    """One after the other, padded to the longest.

    Raises:
        ShapeError: if there is none, or they differ in agents, dimensions or in what is known.
    """
    if not parts:
        raise ShapeError("segments", (0,), "at least one")
    first = parts[0].layout().with_steps(1)
    for part in parts[1:]:
        if part.layout().with_steps(1) != first:
            raise ShapeError("observations", part.segments.observations.shape, f"segments like the first, {first}")
    n_steps = max(part.segments.n_steps for part in parts)

    def joined(arrays: Iterable[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([_lengthened(array, n_steps) for array in arrays])

    segments = SegmentArrays(
        joined(part.segments.observations for part in parts),
        joined(part.segments.actions for part in parts),
        joined(part.segments.mask for part in parts),
    )
    extras = {name: joined(part.extras()[name] for part in parts) for name in parts[0].extras()}
    return SegmentRecords(segments, **extras)


def _lengthened(array: NDArray[Any], n_steps: int) -> NDArray[Any]:
    missing = n_steps - array.shape[1]
    return np.pad(array, [(0, 0), (0, missing), *[(0, 0)] * (array.ndim - 2)]) if missing else array


def records_in_batches(source: SegmentSource, size: int = 256) -> Iterator[SegmentRecords]:
    """All segments in order, `size` at a time; of a folder, with the rewards and simulator states it keeps."""
    for first in range(0, len(source), size):
        index = np.arange(first, min(first + size, len(source)))
        extras: dict[str, NDArray[np.float64]] = {}
        if isinstance(source, SegmentFolder):
            for name in source.layout.columns.keys() & {"rewards", "qpos", "qvel"}:
                extras[name] = getattr(source, name)(index)
        yield SegmentRecords(source.take(index), **extras)


def save_records(
    path: Path | str,
    batches: Iterable[SegmentRecords],
    *,
    n_steps: int | None = None,
    discrete: bool = False,
    about: Mapping[str, Any] | None = None,
) -> SegmentFolder:
    """Write segments into a new folder as they come, in the memory of one batch.

    Args:
        n_steps: the most steps of a segment; those of the first batch when not given.

    Raises:
        AlreadyExists: if there is something at `path`.
        ShapeError: if there is no batch, or one is not like the first. No folder is left then.
    """
    parts = iter(batches)
    first = next(parts, None)
    if first is None:
        raise ShapeError("segments", (0,), "at least one")
    layout = first.layout(discrete=discrete)
    if n_steps is not None:
        layout = layout.with_steps(n_steps)
    with SegmentWriter.create(path, layout, about=about) as writer:
        for part in chain((first,), parts):
            writer.append(part.segments, **part.extras())
    return SegmentFolder.open(path)


#: Segments that are cut before they are handed on.
BATCH_SEGMENTS = 256


@dataclass(frozen=True, slots=True)
class Episode:
    """L steps, from a reset to an end or to where the recording stopped.

    Raises:
        ShapeError: if its arrays do not have the same L.
    """

    #: float32 (L, N, C), what the agents saw when they acted
    observations: FloatArray
    #: float32 (L, N, A)
    actions: FloatArray
    #: float64 (L,), (L, nq), (L, nv); None where they are not known
    rewards: NDArray[np.float64] | None = None
    qpos: NDArray[np.float64] | None = None
    qvel: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        for name, n_dims in (("observations", 3), ("actions", 3), ("rewards", 1), ("qpos", 2), ("qvel", 2)):
            values = getattr(self, name)
            if values is not None and (values.ndim != n_dims or len(values) != len(self)):
                raise ShapeError(name, values.shape, f"{n_dims} dimensions, the first {len(self)}")
        if self.actions.shape[:2] != self.observations.shape[:2]:
            raise ShapeError("actions", self.actions.shape, f"{(*self.observations.shape[:2], 'A')}")

    def __len__(self) -> int:
        return len(self.observations)

    def extras(self) -> dict[str, NDArray[np.float64]]:
        """rewards, qpos and qvel, those that are known."""
        named = {"rewards": self.rewards, "qpos": self.qpos, "qvel": self.qvel}
        return {name: values for name, values in named.items() if values is not None}


@dataclass(frozen=True, slots=True)
class AgentIndices:
    """Which numbers of a flat observation and action belong to which agent; one may belong to several."""

    #: int (N, C) and int (N, A)
    observations: ArrayLike
    actions: ArrayLike

    def split(self, path: Path, observations: FloatArray, actions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(L, D) and (L, K) as (L, N, C) and (L, N, A). Raises InvalidFile if there are too few numbers."""
        try:
            return observations[:, np.asarray(self.observations)], actions[:, np.asarray(self.actions)]
        except IndexError as error:
            raise InvalidFile(path, f"has fewer numbers than the agents' indices need ({error})") from error


def cut_segments(
    episodes: Iterable[Episode], n_steps: int, *, stride: int | None = None, keep_short: bool = False
) -> Iterator[SegmentRecords]:
    """Segments of T steps, none across the end of an episode, some hundreds at a time.

    Args:
        n_steps: T.
        stride: steps from the start of one segment to the next; T when not given, so that none overlap.
        keep_short: keep what is left at an episode's end, shorter than T; otherwise it is left out.

    Raises:
        ShapeError: if the episodes differ in agents, dimensions or in what is known.
    """
    waiting: list[Episode] = []
    for episode in episodes:
        for first in range(0, len(episode), stride or n_steps):
            part = slice(first, first + n_steps)
            if keep_short or first + n_steps <= len(episode):
                extras = {name: values[part] for name, values in episode.extras().items()}
                waiting.append(Episode(episode.observations[part], episode.actions[part], **extras))
            if len(waiting) == BATCH_SEGMENTS:
                yield _stacked(waiting, n_steps)
                waiting = []
    if waiting:
        yield _stacked(waiting, n_steps)


def episodes_of(records: SegmentRecords) -> Iterator[Episode]:
    """Each segment as an episode of its own, without its padding."""
    for index, mask in enumerate(records.segments.mask):
        extras = {name: values[index][mask] for name, values in records.extras().items()}
        yield Episode(records.segments.observations[index][mask], records.segments.actions[index][mask], **extras)


def _stacked(parts: list[Episode], n_steps: int) -> SegmentRecords:
    segments = SegmentArrays.stack([part.observations for part in parts], [part.actions for part in parts])
    extras: dict[str, NDArray[np.float64]] = {}
    for name, first in parts[0].extras().items():
        rows = np.zeros((len(parts), segments.n_steps, *first.shape[1:]))
        for row, part in zip(rows, parts, strict=True):
            values = part.extras().get(name)
            if values is None or values.shape[1:] != first.shape[1:]:
                raise ShapeError(
                    name, () if values is None else values.shape, f"like the first episode's, {first.shape}"
                )
            row[: len(part)] = values
        extras[name] = rows
    return SegmentRecords(segments, **extras)
