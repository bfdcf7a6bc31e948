"""The labels of PreferenceTransformer and Clean-Offline-RLHF: three pickles over a D4RL file.

Two arrays of places say where each segment of a pair begins, a third holds the labels: 0 where the first is better, 1
where the second is, -1 where they are equal; or, from their scripted teachers, rows (1, 0), (0, 1) and (0.5, 0.5).
Skipped pairs were dropped before. The places do not count the file's own rows: they count the transitions of
`d4rl.qlearning_dataset`, which leaves out the last step of every episode that timed out, and the file's last.

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
_KNOWN = "0 (first better), 1 (second better) and -1 (equal), or rows (1, 0), (0, 1) and (0.5, 0.5)"
_TRAJECTORIES = "trajectories.hdf5"


@dataclass(frozen=True, slots=True)
class LabelFiles:
    """The three pickles."""

    labels: Path
    #: where the first and the second segment of each pair begin
    first: Path
    second: Path

    @classmethod
    def find(cls, folder: Path | str) -> "LabelFiles":
        """By their names: one with "label" in it, one with "indices_2", and one more with "indices".

        Raises:
            MissingPart: if one is not there. InvalidFile: if several could be meant.
        """
        folder = Path(folder)
        names = {file.name for file in folder.iterdir() if file.is_file()} if folder.is_dir() else set[str]()
        second = {name for name in names if "indices_2" in name}
        first = {name for name in names if "indices" in name} - second
        # PreferenceTransformer leaves a "label_dummy" of ones beside the people's labels.
        labels = {name for name in names if "label" in name and "dummy" not in name} - first - second
        for what, found in (("labels", labels), ("indices", first), ("indices_2", second)):
            if not found:
                raise MissingPart(folder, f"file of {what}")
            if len(found) > 1:
                raise InvalidFile(folder, f"has several files of {what}: {', '.join(sorted(found))}. Name one")
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
    """
    Args:
        trajectories: D4RL's file of the task that was labelled.
        n_steps: T; their files do not hold it, though often their names do (q100, len_200).
        agents, horizon: see `read_d4rl`.

    Raises:
        UnknownLabel: for a label of another polarity.
        InvalidFile: if a segment would begin or end outside of the file, or cross the end of an episode; if labels
            and places are not as many; see also `read_d4rl` and `load_pickle`.
    """
    labels = _labels(files.labels)
    starts = [_places(path, len(labels)) for path in (files.first, files.second)]
    path = Path(trajectories)
    with open_hdf5(path, max_bytes) as file:
        steps = D4rlSteps(file, agents)
        bounds = episode_bounds(path, steps, horizon)
        row = _transitions(steps, bounds, horizon)
        episode_of_row = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
        sides: list[SegmentRecords] = []
        for name, places in zip((files.first, files.second), starts, strict=True):
            first = _checked_rows(name, places, row, episode_of_row, n_steps)
            parts = cut_segments((steps.read(begin, begin + n_steps) for begin in first.tolist()), n_steps)
            sides.append(concatenate(list(parts)))
    return Comparisons.of_pairs(sides[0], sides[1], labels)


def write_offline_labels(folder: Path | str, comparisons: Comparisons) -> LabelFiles:
    """Write comparisons for PreferenceTransformer: `trajectories.hdf5` and the three pickles. Skips are left out.

    Each segment becomes an episode, with its last step twice, since the last one of an episode is not counted.

    Raises:
        AlreadyExists: if there is something at `folder`.
        NotRepresentable: if a label is not 1, 0 or 0.5, or the segments differ in length. Nothing is left then.
    """
    folder = Path(folder)
    if folder.exists():
        raise AlreadyExists(folder)
    words = {ours: theirs for theirs, ours in _LABELS.items()}
    said = ~np.isnan(comparisons.labels)
    unknown = sorted(set(comparisons.labels[said].tolist()) - words.keys())
    if unknown:
        raise NotRepresentable(folder, f"a label of {unknown[0]} has no place in this format, only 1, 0 and 0.5")
    n_steps = comparisons.records.segments.n_steps
    if (comparisons.records.lengths != n_steps).any():
        raise NotRepresentable(folder, "segments of unequal length have no place in this format")
    pairs = comparisons.pairs[said]
    ends = f"num{len(pairs)}_q{n_steps}"
    files = LabelFiles(folder / "label_human", folder / f"indices_{ends}", folder / f"indices_2_{ends}")
    folder.mkdir(parents=True)
    try:
        write_d4rl(folder / _TRAJECTORIES, _with_last_step_twice(comparisons.records))
        for path, places in ((files.first, pairs[:, 0]), (files.second, pairs[:, 1])):
            write_pickle(path, (places * n_steps).astype(np.int32))
        labels = np.array([words[label] for label in comparisons.labels[said].tolist()], dtype=np.int64)
        write_pickle(files.labels, labels)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return files


def _with_last_step_twice(records: SegmentRecords) -> Iterator[Episode]:
    for episode in episodes_of(records):
        twice = np.array([*range(len(episode)), len(episode) - 1])
        extras = {name: values[twice] for name, values in episode.extras().items()}
        yield Episode(episode.observations[twice], episode.actions[twice], **extras)


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


def _places(path: Path, n_labels: int) -> IntArray:
    found = numbers(path, "indices", load_pickle(path), 1)
    places = found.astype(np.int64)
    if (places != found).any() or (places < 0).any():
        raise InvalidFile(path, "holds a place that is no row")
    if len(places) != n_labels:
        raise InvalidFile(path, f"holds {len(places)} places for {n_labels} labels")
    return places


def _transitions(steps: D4rlSteps, bounds: list[int], horizon: int | None) -> IntArray:
    """The file's row of each transition of `d4rl.qlearning_dataset`."""
    left_out = steps.flag("timeouts")
    if left_out is None:
        left_out = np.zeros(len(steps), dtype=np.bool_)
        left_out[[last - 1 for first, last in pairwise(bounds) if last - first == horizon]] = True
    left_out[-1] = True
    return np.flatnonzero(~left_out)


def _checked_rows(
    path: Path, places: IntArray, row: IntArray, episode_of_row: NDArray[np.int64], n_steps: int
) -> IntArray:
    """The file's row where each segment begins."""
    outside = places + n_steps > len(row)
    if outside.any():
        index = int(outside.argmax())
        raise InvalidFile(
            path, f"pair {index} begins at {places[index]}, and {n_steps} steps from there is beyond {len(row)}"
        )
    first, last = row[places], row[places + n_steps - 1]
    crossing = episode_of_row[first] != episode_of_row[last]
    if crossing.any():
        index = int(crossing.argmax())
        raise InvalidFile(
            path, f"pair {index} crosses the end of an episode: is this the file, and T = {n_steps}, that was labelled?"
        )
    return first
