"""Labels of Preference Transformer and Clean-Offline-RLHF: three pickles that index a D4RL file.

Two arrays hold the index at which each segment of a pair starts. The third array holds the labels: 0 if the first is
preferred, 1 if the second is, -1 if they are equal; or, from scripted teachers, rows (1, 0), (0, 1) and (0.5, 0.5).
There are no skips.
Indices count the transitions of `d4rl.qlearning_dataset`, which drops the last step of every episode that timed out,
and the last step of the file.

Sources: https://github.com/csmile-1006/PreferenceTransformer, JaxPref/reward_transform.py;
https://github.com/pickxiguapi/Clean-Offline-RLHF, rlhf/train_reward_model.py.
"""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapt.errors import AlreadyExists, InvalidFile, MissingPart, NotRepresentable, UnknownLabel
from mapt.preferences.dataset import FloatArray, IntArray
from mapt.preferences.formats.arrays import MAX_BYTES, numbers, open_hdf5
from mapt.preferences.formats.d4rl import D4rlSteps, episode_bounds, write_d4rl
from mapt.preferences.formats.pickle_writer import write_pickle
from mapt.preferences.formats.pickles import load_pickle
from mapt.preferences.formats.records import (
    AgentIndices,
    Comparisons,
    Episode,
    SegmentRecords,
    concatenate,
    cut_segments,
    episodes_of,
)

_LABELS = {0: 1.0, 1: 0.0, -1: 0.5}
_KNOWN = "0 (first preferred), 1 (second preferred) and -1 (equal), or rows (1, 0), (0, 1) and (0.5, 0.5)"
_TRAJECTORIES = "trajectories.hdf5"


@dataclass(frozen=True, slots=True)
class LabelFiles:
    """The three pickles."""

    labels: Path
    #: start indices of the first and of the second segment of each pair
    first: Path
    second: Path

    @classmethod
    def find(cls, folder: Path | str) -> "LabelFiles":
        """Find the files by their names, which contain "label", "indices_2" and "indices".

        Raises:
            MissingPart: if a file is missing.
            InvalidFile: if several files match.
        """
        folder = Path(folder)
        names = {file.name for file in folder.iterdir() if file.is_file()} if folder.is_dir() else set[str]()
        second = {name for name in names if "indices_2" in name}
        first = {name for name in names if "indices" in name} - second
        # Preference Transformer writes a "label_dummy" of ones next to the human labels.
        labels = {name for name in names if "label" in name and "dummy" not in name} - first - second
        for what, found in (("labels", labels), ("indices", first), ("indices_2", second)):
            if not found:
                raise MissingPart(folder, f"file of {what}")
            if len(found) > 1:
                raise InvalidFile(folder, f"has several files of {what}: {', '.join(sorted(found))}. Choose one")
        return cls(folder / labels.pop(), folder / first.pop(), folder / second.pop())


def read_offline_labels(
    trajectories: Path | str,
    files: LabelFiles,
    n_steps: int,
    *,
    agents: AgentIndices | None = None,
    horizon: int | None = None,
    max_bytes: int = MAX_BYTES,
) -> Comparisons:
    """Read labels and the segments that they refer to.

    Args:
        trajectories: the D4RL file that was labelled.
        n_steps: T. The files do not contain it; their names often do (q100, len_200).
        agents, horizon: as in `read_d4rl`.

    Raises:
        UnknownLabel: for a label that the format does not define.
        InvalidFile: if a segment exceeds the file or crosses the end of an episode, or if labels and indices differ in
            number; see also `read_d4rl` and `load_pickle`.
    """
    labels = _labels(files.labels)
    starts = [_indices(path, len(labels)) for path in (files.first, files.second)]
    path = Path(trajectories)
    with open_hdf5(path, max_bytes) as file:
        steps = D4rlSteps(file, agents)
        bounds = episode_bounds(path, steps, horizon)
        row = _transitions(steps, bounds, horizon)
        episode_of_row = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
        sides: list[SegmentRecords] = []
        for name, indices in zip((files.first, files.second), starts, strict=True):
            first = _checked_rows(name, indices, row, episode_of_row, n_steps)
            parts = cut_segments((steps.read(start, start + n_steps) for start in first.tolist()), n_steps)
            sides.append(concatenate(list(parts)))
    return Comparisons.of_pairs(sides[0], sides[1], labels)


def write_offline_labels(folder: Path | str, comparisons: Comparisons) -> LabelFiles:
    """Write comparisons for Preference Transformer: `trajectories.hdf5` and the three pickles, without skips.

    Each segment becomes an episode with a repeated last step, because the last step of an episode is not indexed.

    Raises:
        AlreadyExists: if `folder` exists.
        NotRepresentable: if a label is not 1, 0 or 0.5, or the segments differ in length. Nothing is left.
    """
    folder = Path(folder)
    if folder.exists():
        raise AlreadyExists(folder)
    stored = {label: value for value, label in _LABELS.items()}
    labelled = ~np.isnan(comparisons.labels)
    unknown = sorted(set(comparisons.labels[labelled].tolist()) - stored.keys())
    if unknown:
        raise NotRepresentable(folder, f"cannot hold a label of {unknown[0]}: its format has only 1, 0 and 0.5")
    n_steps = comparisons.records.segments.n_steps
    if (comparisons.records.lengths != n_steps).any():
        raise NotRepresentable(folder, "cannot hold segments of different lengths: its format has one length")
    pairs = comparisons.pairs[labelled]
    suffix = f"num{len(pairs)}_q{n_steps}"
    files = LabelFiles(folder / "label_human", folder / f"indices_{suffix}", folder / f"indices_2_{suffix}")
    folder.mkdir(parents=True)
    try:
        write_d4rl(folder / _TRAJECTORIES, _with_repeated_last_step(comparisons.records))
        for path, segments in ((files.first, pairs[:, 0]), (files.second, pairs[:, 1])):
            write_pickle(path, (segments * n_steps).astype(np.int32))
        labels = np.array([stored[label] for label in comparisons.labels[labelled].tolist()], dtype=np.int64)
        write_pickle(files.labels, labels)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return files


def _with_repeated_last_step(records: SegmentRecords) -> Iterator[Episode]:
    for episode in episodes_of(records):
        steps = episode.steps_with_last_twice
        extras = {name: values[steps] for name, values in episode.extras().items()}
        yield Episode(episode.observations[steps], episode.actions[steps], **extras)


def _labels(path: Path) -> FloatArray:
    found = np.asarray(load_pickle(path))
    if found.ndim == 2 and found.shape[1] == 2:
        found = numbers(path, "labels", found, 2)
        rows = found.tolist()
        known = {(1, 0): 1.0, (0, 1): 0.0, (0.5, 0.5): 0.5}
        for index, row in enumerate(rows):
            if tuple(row) not in known:
                raise UnknownLabel(path, index, tuple(row), _KNOWN)
        return np.array([known[row[0], row[1]] for row in rows], dtype=np.float32)
    flat = numbers(path, "labels", found, 1).tolist()
    for index, label in enumerate(flat):
        if label not in _LABELS:
            raise UnknownLabel(path, index, label, _KNOWN)
    return np.array([_LABELS[label] for label in flat], dtype=np.float32)


def _indices(path: Path, n_labels: int) -> IntArray:
    found = numbers(path, "indices", load_pickle(path), 1)
    indices = found.astype(np.int64)
    if (indices != found).any() or (indices < 0).any():
        raise InvalidFile(path, "holds an index that is negative or not a whole number")
    if len(indices) != n_labels:
        raise InvalidFile(path, f"holds {len(indices)} indices for {n_labels} labels")
    return indices


def _transitions(steps: D4rlSteps, bounds: list[int], horizon: int | None) -> IntArray:
    """The row in the file of each transition of `d4rl.qlearning_dataset`."""
    dropped = steps.flag("timeouts")
    if dropped is None:
        dropped = np.zeros(len(steps), dtype=np.bool_)
        dropped[[last - 1 for first, last in pairwise(bounds) if last - first == horizon]] = True
    dropped[-1] = True
    return np.flatnonzero(~dropped)


def _checked_rows(
    path: Path, indices: IntArray, row: IntArray, episode_of_row: NDArray[np.int64], n_steps: int
) -> IntArray:
    """The row in the file at which each segment starts."""
    outside = indices + n_steps > len(row)
    if outside.any():
        index = int(outside.argmax())
        raise InvalidFile(
            path, f"has steps {indices[index]} to {indices[index] + n_steps} of only {len(row)} in pair {index}"
        )
    first, last = row[indices], row[indices + n_steps - 1]
    crossing = episode_of_row[first] != episode_of_row[last]
    if crossing.any():
        index = int(crossing.argmax())
        raise InvalidFile(
            path,
            f"has a segment in pair {index} that crosses the end of an episode. Check it and n_steps = {n_steps}",
        )
    return first
