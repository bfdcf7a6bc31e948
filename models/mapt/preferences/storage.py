"""Segments on disk, read by index in the memory of what is asked for.

    with SegmentWriter.create(path, SegmentLayout(n_steps=100, n_agents=6, observation_dim=24, action_dim=1)) as writer:
        writer.append(segments)
    folder = SegmentFolder.open(path)
    dataset = PreferenceDataset(folder, pairs, labels)

Read, not mapped: a mapped file counts its touched pages as the process's own memory, which a pass over all the
segments makes the whole file. What is read lies in the system's page cache and goes when memory is wanted.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import InvalidFile, MissingPart, TruncatedFile
from mapt.preferences.dataset import FloatArray, IntArray, SegmentArrays
from mapt.preferences.storage_layout import Column, Manifest, SegmentLayout, column_path
from mapt.preferences.storage_writer import SegmentWriter

__all__ = ["SegmentFolder", "SegmentLayout", "SegmentWriter"]


@dataclass(frozen=True, slots=True, eq=False)
class SegmentFolder:
    """S segments in a folder; a `SegmentSource`. Holds no open file, so it can be pickled, forked and forgotten.

    It sees the segments that were committed when it was opened; a writer may append more meanwhile.
    """

    path: Path
    layout: SegmentLayout
    #: what the writer said of them
    about: Mapping[str, Any]
    #: int32 (S,), real steps of each segment
    lengths: NDArray[np.int32]

    @classmethod
    def open(cls, path: Path | str) -> "SegmentFolder":
        """
        Raises:
            MissingPart: if it is no folder of segments, or one of its files is gone.
            NewerFile: if a newer mapt wrote it.
            TruncatedFile: if a file is shorter than the manifest says.
            InvalidFile: if the manifest or the lengths make no sense.
        """
        path = Path(path)
        manifest = Manifest.read(path)
        layout, n_segments = manifest.layout, manifest.n_segments
        for name, column in layout.columns.items():
            file = column_path(path, name)
            if not file.is_file():
                raise MissingPart(path, file.name)
            if file.stat().st_size < n_segments * column.row_bytes:
                raise TruncatedFile(file, f"holds fewer than {n_segments} segments")
        lengths = _read_rows(path, "lengths", layout.columns["lengths"], np.arange(n_segments))
        if ((lengths < 1) | (lengths > layout.n_steps)).any():
            raise InvalidFile(column_path(path, "lengths"), f"holds a length that is not within 1 to {layout.n_steps}")
        return cls(path, layout, manifest.about, lengths.astype(np.int32))

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def n_steps(self) -> int:
        return self.layout.n_steps

    @property
    def n_agents(self) -> int:
        return self.layout.n_agents

    @property
    def observation_dim(self) -> int:
        return self.layout.observation_dim

    @property
    def action_dim(self) -> int:
        return self.layout.action_dim

    def mask(self, indices: ArrayLike) -> NDArray[np.bool_]:
        """bool (B, T), true where the step is real."""
        return np.arange(self.n_steps) < self.lengths[self._index(indices)][:, None]

    def take(self, indices: ArrayLike) -> SegmentArrays:
        """The segments at `indices`, int (B,), in that order, as new arrays.

        Raises:
            IndexError: if one is not in [0, S).
            TruncatedFile: if a file has been cut since it was opened.
        """
        index = self._index(indices)
        mask = self.mask(index)
        actions = self._rows("actions", index)
        if self.layout.discrete:
            actions = _one_hot(actions, self.action_dim, mask)
        return SegmentArrays(self._rows("observations", index), actions, mask)

    def rewards(self, indices: ArrayLike) -> NDArray[np.float64]:
        """True rewards, float64 (B, T), 0 in the padding. Raises MissingPart where none are kept."""
        return self._rows("rewards", self._index(indices))

    def qpos(self, indices: ArrayLike) -> NDArray[np.float64]:
        """Simulator positions, float64 (B, T, nq). Raises MissingPart where none are kept."""
        return self._rows("qpos", self._index(indices))

    def qvel(self, indices: ArrayLike) -> NDArray[np.float64]:
        """Simulator velocities, float64 (B, T, nv). Raises MissingPart where none are kept."""
        return self._rows("qvel", self._index(indices))

    def _rows(self, name: str, index: IntArray) -> NDArray[Any]:
        column = self.layout.columns.get(name)
        if column is None:
            raise MissingPart(self.path, name)
        return _read_rows(self.path, name, column, index)

    def _index(self, indices: ArrayLike) -> IntArray:
        index = np.asarray(indices)
        if index.ndim != 1 or (index.dtype.kind not in "iu" and index.size):
            raise IndexError(f"indices must be integers (B,), not {index.dtype} {index.shape}")
        index = index.astype(np.int64)
        outside = (index < 0) | (index >= len(self))
        if outside.any():
            raise IndexError(f"there is no segment {index[outside][0]} among {len(self)}")
        return index


def _read_rows(folder: Path, name: str, column: Column, index: IntArray) -> NDArray[Any]:
    """Rows of one array, successive ones in a single read."""
    rows = np.empty((len(index), *column.shape), dtype=column.dtype)
    path = column_path(folder, name)
    bounds = [*np.flatnonzero(np.diff(index, prepend=-2) != 1).tolist(), len(index)]
    with path.open("rb", buffering=0) as file:
        for first, last in pairwise(bounds):
            file.seek(int(index[first]) * column.row_bytes)
            _fill(file, rows[first:last], path)
    return rows


def _fill(file: BinaryIO, rows: NDArray[Any], path: Path) -> None:
    rest = rows.reshape(-1).view(np.uint8).data
    while rest:
        # One system call gives at most 2 GiB.
        n_bytes = file.readinto(rest)  # pyright: ignore[reportAttributeAccessIssue]
        if not n_bytes:
            raise TruncatedFile(path)
        rest = rest[n_bytes:]


def _one_hot(codes: NDArray[np.uint16], n_actions: int, mask: NDArray[np.bool_]) -> FloatArray:
    actions = np.zeros((*codes.shape, n_actions), dtype=np.float32)
    np.put_along_axis(actions, codes[..., None].astype(np.int64), 1.0, axis=-1)
    actions[~mask] = 0
    return actions
