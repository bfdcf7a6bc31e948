"""Appends segments to a folder, in the memory of one batch; a crash loses at most what was not committed."""

import os
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import AlreadyExists, NotFinite, ShapeError, TruncatedFile
from mapt.preferences.actions import action_numbers
from mapt.preferences.dataset import IntArray, SegmentArrays
from mapt.preferences.storage_layout import (
    MANIFEST,
    Column,
    Manifest,
    SegmentLayout,
    column_path,
)


class SegmentWriter:
    """One writer of a folder of segments; make it with `create` or `resume`, end it with the block or `close`.

    A block that raises leaves the folder with what was committed before, and a folder that never had any as if
    it had not been made.
    """

    def __init__(self, path: Path, manifest: Manifest) -> None:
        """Use `create` or `resume`."""
        self.path, self.layout = path, manifest.layout
        self._about = manifest.about
        self._committed = self._count = manifest.n_segments
        self._stack = ExitStack()
        self._files = {name: self._opened(name, column) for name, column in self.layout.columns.items()}

    @classmethod
    def create(cls, path: Path | str, layout: SegmentLayout, *, about: Mapping[str, Any] | None = None) -> Self:
        """A new folder.

        Args:
            about: where the segments come from (task, versions, seeds); kept in the manifest as JSON.

        Raises:
            AlreadyExists: if the folder holds segments, or anything that is not the rest of a write that crashed.
        """
        path = Path(path)
        names = {column_path(path, name).name for name in layout.columns}
        if path.exists() and not (path.is_dir() and {each.name for each in path.iterdir()} <= names):
            raise AlreadyExists(path)
        path.mkdir(parents=True, exist_ok=True)
        return cls(path, Manifest(layout, 0, about or {}))

    @classmethod
    def resume(cls, path: Path | str) -> Self:
        """Go on after the last committed segment of a folder.

        Raises:
            MissingPart, NewerFile, InvalidFile: see `SegmentFolder.open`.
            TruncatedFile: if a file holds fewer segments than were committed.
        """
        return cls(Path(path), Manifest.read(Path(path)))

    def __len__(self) -> int:
        return self._count

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()

    def append(
        self,
        segments: SegmentArrays,
        *,
        rewards: ArrayLike | None = None,
        qpos: ArrayLike | None = None,
        qvel: ArrayLike | None = None,
    ) -> IntArray:
        """Add B segments behind those that are there.

        Args:
            segments: of at most the layout's T steps; what they lack is padded.
            rewards: (B, T'), qpos: (B, T', nq), qvel: (B, T', nv), T' the steps of `segments`; each is given
                where the layout has it, and not otherwise. What lies in the padding is set to 0.

        Returns:
            int64 (B,): the indices they have got.

        Raises:
            ShapeError, NotFinite, NotOneHot: if an array is not the layout's; nothing is added then.
        """
        given = {"rewards": rewards, "qpos": qpos, "qvel": qvel}
        columns = {
            "lengths": segments.mask.sum(axis=1),
            "observations": self._checked("observations", segments.observations, segments.mask),
            "actions": self._actions(segments),
        }
        for name, values in given.items():
            if (values is None) != (name not in self.layout.columns):
                raise ShapeError(
                    name, () if values is None else np.shape(values), "an array exactly where the layout keeps one"
                )
            if values is not None:
                columns[name] = self._checked(name, np.asarray(values), segments.mask)
        for name, values in columns.items():
            column = self.layout.columns[name]
            # To its place, not merely behind the last byte: a write that failed half-way is then written over.
            self._files[name].seek(self._count * column.row_bytes)
            self._files[name].write(_padded(values, column, segments.mask).data)
        first, self._count = self._count, self._count + len(segments)
        return np.arange(first, self._count)

    def commit(self) -> None:
        """Make every segment so far survive a crash and be seen by those who open the folder from now on."""
        for file in self._files.values():
            file.flush()
            os.fsync(file.fileno())
        Manifest(self.layout, self._count, self._about).write(self.path)
        self._committed = self._count

    def close(self) -> None:
        """Commit, and let go of the files."""
        with self._stack:
            self.commit()

    def abandon(self) -> None:
        """Let go of the files without committing; a folder that was never committed is removed."""
        self._stack.close()
        if (self.path / MANIFEST).exists():
            for name, column in self.layout.columns.items():
                os.truncate(column_path(self.path, name), self._committed * column.row_bytes)
            return
        for name in self.layout.columns:
            column_path(self.path, name).unlink(missing_ok=True)
        self.path.rmdir()

    def _opened(self, name: str, column: Column) -> BinaryIO:
        path = column_path(self.path, name)
        try:
            if self._committed and path.stat().st_size < self._committed * column.row_bytes:
                raise TruncatedFile(path, f"holds fewer than {self._committed} segments")
            file = self._stack.enter_context(path.open("r+b" if self._committed else "wb"))
        except BaseException:
            self._stack.close()
            raise
        # What lies behind the committed rows is the rest of a write that never ended.
        file.truncate(self._committed * column.row_bytes)
        return file

    def _actions(self, segments: SegmentArrays) -> NDArray[Any]:
        layout, actions = self.layout, segments.actions
        if actions.shape[2:] != (layout.n_agents, layout.action_dim):
            raise ShapeError("actions", actions.shape, f"(B, T, {layout.n_agents}, {layout.action_dim})")
        return action_numbers(segments) if layout.discrete else actions

    def _checked(self, name: str, values: NDArray[Any], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """`values`, if they have the layout's dimensions, at most its steps, and no NaN where the step is real."""
        row = self.layout.columns[name].shape
        if values.shape[:2] != mask.shape or values.shape[1] > row[0] or values.shape[2:] != row[1:]:
            raise ShapeError(name, values.shape, f"({', '.join(map(str, (*mask.shape, *row[1:])))}), T <= {row[0]}")
        finite = np.isfinite(values).all(axis=tuple(range(2, values.ndim)))
        broken = (~finite & mask).any(axis=1)
        if broken.any():
            raise NotFinite(name, int(broken.argmax()))
        return values


def _padded(values: NDArray[Any], column: Column, mask: NDArray[np.bool_]) -> NDArray[Any]:
    """(B, T', ...) as the column's (B, T, ...), with zeros where the mask (B, T') is false and beyond it."""
    rows = np.zeros((len(values), *column.shape), dtype=column.dtype)
    if not column.shape:
        rows[:] = values
    else:
        rows[:, : mask.shape[1]][mask] = values[mask]
    return rows
