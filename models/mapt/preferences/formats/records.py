"""What every format is turned into, and made from: segments with what is known of them, and comparisons."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import ShapeError
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
