"""The pickled `PreferenceDataset` of imitation (1.0): fragments, and the probability that the first is preferred.

A fragment has `obs` (T + 1, ...), `acts` (T, ...), `rews` (T,), `infos` and `terminal`. Observations and actions of
several agents are (T + 1, N, C) and (T, N, A); of one, (T + 1, C) and (T, A), or (T,) numbers where actions are
discrete. Its polarity is ours: 1 where the first is better, 0 where the second is, 0.5 where they are equal, and
anything between. Skipped pairs have no place in it.

Source: https://github.com/HumanCompatibleAI/imitation, algorithms/preference_comparisons.py and data/types.py.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mapt.errors import InvalidFile, MissingPart, UnknownLabel
from mapt.preferences.formats.arrays import as_array, finite_doubles, finite_floats, numbered_actions, numbers
from mapt.preferences.formats.episodes import Episode, cut_segments, episodes_of
from mapt.preferences.formats.pickle_writer import write_pickle
from mapt.preferences.formats.pickles import MAX_BYTES, Record, load_pickle
from mapt.preferences.formats.records import Comparisons, SegmentRecords, concatenate

_DATASET = "imitation.algorithms.preference_comparisons.PreferenceDataset"
_FRAGMENT = "imitation.data.types.TrajectoryWithRew"
_KNOWN = "1 (first better), 0 (second better), 0.5 (equal), or a probability between"


def read_imitation(path: Path | str, *, n_actions: int | None = None, max_bytes: int = MAX_BYTES) -> Comparisons:
    """
    Args:
        n_actions: of a task with discrete actions: their numbers become one-hot.

    Raises:
        InvalidFile: with the first fragment that is not of this format; see also `load_pickle`.
        UnknownLabel: for a preference that is no probability.
        ShapeError: if the fragments differ in agents or dimensions.
    """
    path = Path(path)
    found = load_pickle(path, (_DATASET, _FRAGMENT), max_bytes=max_bytes)
    if not isinstance(found, Record) or found.name != _DATASET:
        raise InvalidFile(path, "is no PreferenceDataset of imitation")
    labels = numbers(path, "preferences", _part(path, "dataset", found, "preferences"), 1).astype(np.float32)
    for index, label in enumerate(labels.tolist()):
        if not 0 <= label <= 1:
            raise UnknownLabel(path, index, label, _KNOWN)
    first, second = (_side(path, found, name, len(labels), n_actions) for name in ("fragments1", "fragments2"))
    return Comparisons.of_pairs(first, second, labels)


def write_imitation(path: Path | str, comparisons: Comparisons) -> None:
    """Write comparisons for `PreferenceDataset.load`. Skips are left out.

    What was seen after the last action is not known: the last observation is there twice. Rewards that are not
    known are 0.

    Raises:
        AlreadyExists: if there is a file.
    """
    said = ~np.isnan(comparisons.labels)
    pairs = comparisons.pairs[said]

    def fragments(side: int) -> Iterator[Record]:
        for segment in pairs[:, side].tolist():
            (episode,) = episodes_of(comparisons.records.take([segment]))
            yield _fragment(episode)

    dataset = {
        "fragments1": fragments(0),
        "fragments2": fragments(1),
        "max_size": None,
        "preferences": comparisons.labels[said],
    }
    write_pickle(Path(path), Record(_DATASET, dataset))


def _fragment(episode: Episode) -> Record:
    twice = np.array([*range(len(episode)), len(episode) - 1])
    rewards = np.zeros(len(episode)) if episode.rewards is None else episode.rewards
    fields = {"obs": episode.observations[twice], "acts": episode.actions, "infos": None, "terminal": False}
    return Record(_FRAGMENT, fields | {"rews": rewards})


def _side(path: Path, dataset: Record, name: str, n_pairs: int, n_actions: int | None) -> SegmentRecords:
    fragments = _part(path, "dataset", dataset, name)
    if not isinstance(fragments, list) or len(fragments) != n_pairs or not fragments:
        raise InvalidFile(path, f"{name} are not as many as its preferences, {n_pairs}")
    episodes = [_episode(path, f"{name}[{index}]", each, n_actions) for index, each in enumerate(fragments)]
    longest = max(len(episode) for episode in episodes)
    return concatenate(list(cut_segments(episodes, longest, keep_short=True)))


def _episode(path: Path, where: str, fragment: object, n_actions: int | None) -> Episode:
    if not isinstance(fragment, Record) or fragment.name != _FRAGMENT:
        raise InvalidFile(path, f"{where} is no TrajectoryWithRew")
    observed, acted = (_part(path, where, fragment, name) for name in ("obs", "acts"))
    observations = finite_floats(path, f"obs of {where}", _of_agents(path, where, observed, 2), 3)
    if n_actions is None:
        actions = finite_floats(path, f"acts of {where}", _of_agents(path, where, acted, 2), 3)
    else:
        actions = numbered_actions(path, f"acts of {where}", _of_agents(path, where, acted, 1), n_actions)
    rewards = finite_doubles(path, f"rews of {where}", _part(path, where, fragment, "rews"), 1)
    n_steps = len(actions)
    if len(observations) != n_steps + 1 or len(rewards) != n_steps:
        raise InvalidFile(path, f"{where} has {len(observations)} obs, {n_steps} acts and {len(rewards)} rews")
    if observations.shape[1] != actions.shape[1]:
        raise InvalidFile(path, f"{where} has obs of {observations.shape[1]} agents and acts of {actions.shape[1]}")
    return Episode(observations[:-1], actions, rewards)


def _of_agents(path: Path, where: str, values: object, dims_of_one: int) -> Any:
    """With a dimension of one agent where there is none."""
    array = as_array(path, where, values)
    return array[:, None] if array.ndim == dims_of_one else array


def _part(path: Path, where: str, record: Record, name: str) -> Any:
    if name not in record.fields:
        raise MissingPart(path, f"{name!r} in {where}")
    return record.fields[name]
