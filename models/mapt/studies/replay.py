"""A recorded replay: segments of a policy's training with true rewards and simulator states, as they were made."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.preferences.dataset import SegmentArrays, SegmentSource
from mapt.preferences.storage import SegmentFolder
from mapt.preferences.storage_layout import MANIFEST, column_path
from mapt.studies.errors import NoTrueRewards, ReplayNotFound

_BYTES_AT_ONCE = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """S segments of T steps, in the order they were made; observations, actions and states stay on disk."""

    path: Path
    source: SegmentFolder
    #: the task's own reward, float64 (S, T), 0 in the padding
    rewards: NDArray[np.float64]
    #: bool (S, T), true where the step is real
    mask: NDArray[np.bool_]

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open the replay in a folder, one of `SegmentFolder`.

        Raises:
            ReplayNotFound: if there is none.
            NoTrueRewards: if its segments were kept without.
            FileError: if it is not whole.
        """
        if not (path / MANIFEST).is_file():
            raise ReplayNotFound(path)
        source = SegmentFolder.open(path)
        if not source.layout.rewards:
            raise NoTrueRewards(path)
        everything = np.arange(len(source))
        return cls(path, source, source.rewards(everything), source.mask(everything))

    def __len__(self) -> int:
        return len(self.source)

    @property
    def origin(self) -> Mapping[str, Any]:
        """How it was recorded, see `Recording`."""
        return self.source.about

    @property
    def returns(self) -> NDArray[np.float64]:
        """True return of each segment, (S,)."""
        return self.rewards.sum(axis=1)

    def segments(self, indices: ArrayLike) -> SegmentArrays:
        """What a reward model sees of the segments at `indices`, in that order, read into memory."""
        return self.source.take(indices)

    def view(self, indices: ArrayLike) -> "SegmentView":
        """The segments at `indices` as a source of their own, which stays on disk."""
        return SegmentView(self.source, np.asarray(indices, dtype=np.int64))

    def fingerprint(self) -> str:
        """SHA-256 of every number in it: two replays with the same fingerprint are the same. Reads all its files."""
        digest = hashlib.sha256()
        for name, column in sorted(self.source.layout.columns.items()):
            digest.update(f"{name} {column} {len(self)}\n".encode())
            rest = len(self) * column.row_bytes
            with column_path(self.path, name).open("rb") as file:
                while rest and (part := file.read(min(rest, _BYTES_AT_ONCE))):
                    digest.update(part)
                    rest -= len(part)
        return digest.hexdigest()


@dataclass(frozen=True, slots=True, eq=False)
class SegmentView:
    """Some segments of a source, as a `SegmentSource`."""

    source: SegmentSource
    #: int64 (S,)
    indices: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def n_steps(self) -> int:
        """T."""
        return self.source.n_steps

    @property
    def n_agents(self) -> int:
        """N."""
        return self.source.n_agents

    @property
    def observation_dim(self) -> int:
        """C."""
        return self.source.observation_dim

    @property
    def action_dim(self) -> int:
        """A."""
        return self.source.action_dim

    def take(self, indices: ArrayLike) -> SegmentArrays:
        """See `SegmentSource.take`."""
        return self.source.take(self.indices[np.asarray(indices)])
