"""Episodes of other programs, and the segments that are cut from them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import InvalidFile, ShapeError
from mapt.preferences.dataset import FloatArray, SegmentArrays
from mapt.preferences.formats.records import SegmentRecords

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
