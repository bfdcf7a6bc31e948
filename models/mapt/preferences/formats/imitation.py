"""The pickled `PreferenceDataset` of imitation (1.0): fragments, and the probability that the first is preferred.

A fragment has `obs` (T + 1, ...), `acts` (T, ...), `rews` (T,), `infos` and `terminal`. Observations and actions of
several agents are (T + 1, N, C) and (T, N, A); of one, (T + 1, C) and (T, A), or (T,) numbers where actions are
discrete. Its polarity is ours: 1 where the first is better, 0 where the second is, 0.5 where they are equal, and
anything between. Skipped pairs have no place in it.

Source: https://github.com/HumanCompatibleAI/imitation, algorithms/preference_comparisons.py and data/types.py.
"""

import json
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from mapt.errors import AlreadyExists, FileTooLarge, InvalidFile, MissingPart, ShapeError, TruncatedFile, UnknownLabel
from mapt.io import atomic_write
from mapt.preferences.formats.arrays import as_array, finite_doubles, finite_floats, numbered_actions, numbers
from mapt.preferences.formats.pickle_writer import write_pickle
from mapt.preferences.formats.pickles import MAX_BYTES, Record, load_pickle
from mapt.preferences.formats.records import (
    Comparisons,
    Episode,
    SegmentRecords,
    concatenate,
    cut_segments,
    episodes_of,
)

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


#: The largest file that is read: a damaged one may claim any size.
MAX_ARROW_BYTES = 16 << 30
#: What an Arrow stream ends with.
_END = b"\xff\xff\xff\xff\0\0\0\0"
_STATE, _INFO = "state.json", "dataset_info.json"


def read_imitation_trajectories(
    path: Path | str, *, n_actions: int | None = None, max_bytes: int = MAX_ARROW_BYTES
) -> Iterator[Episode]:
    """Episodes in their order, some hundreds in memory at a time. The last observation of each is left out.

    Args:
        path: the folder that `imitation.data.serialize.save` made.
        n_actions: of a task with discrete actions: their numbers become one-hot.

    Raises:
        MissingPart: if a file or a column is not there.
        InvalidFile: if a file is cut, or a trajectory is not of this format.
    """
    folder = Path(path)
    for file in _data_files(folder):
        if file.stat().st_size > max_bytes:
            raise FileTooLarge(file, f"{file.stat().st_size} bytes", max_bytes)
        for batch in _batches(file):
            for name in ("obs", "acts"):
                if name not in batch.schema.names:
                    raise MissingPart(file, f"column {name!r}")
            for index in range(batch.num_rows):
                yield _trajectory(file, batch, index, n_actions)


def write_imitation_trajectories(path: Path | str, episodes: Iterable[Episode]) -> None:
    """Write episodes for `imitation.data.serialize.load`, one in memory at a time.

    What was seen after the last action is not known: the last observation is there twice.

    Raises:
        AlreadyExists: if there is something at `path`.
        ShapeError: if there is no episode, or rewards are known of some and not of others. Nothing is left then.
    """
    folder = Path(path)
    if folder.exists():
        raise AlreadyExists(folder)
    folder.mkdir(parents=True)
    try:
        _write_trajectories(folder, episodes)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _write_trajectories(folder: Path, episodes: Iterable[Episode]) -> None:
    parts = iter(episodes)
    first = next(parts, None)
    if first is None:
        raise ShapeError("episodes", (0,), "at least one")
    columns = {"obs": 3, "acts": 3, "infos": 0, "terminal": 0} | ({} if first.rewards is None else {"rews": 1})
    types = {"infos": pa.list_(pa.string()), "terminal": pa.bool_(), "rews": pa.list_(pa.float64())}
    schema = pa.schema([(name, types.get(name) or _nested(pa.float32(), dims)) for name, dims in columns.items()])
    name = "data-00000-of-00001.arrow"
    with pa.OSFile(str(folder / name), "wb") as file, pa.ipc.new_stream(file, schema) as stream:
        stream.write_batch(_row(first, schema))
        for episode in parts:
            if (episode.rewards is None) != (first.rewards is None):
                raise ShapeError("rewards", (), "known of every episode or of none")
            stream.write_batch(_row(episode, schema))
    state = {
        "_data_files": [{"filename": name}],
        "_fingerprint": secrets.token_hex(8),
        "_format_columns": None,
        "_format_kwargs": {},
        "_format_type": None,
        "_output_all_columns": False,
        "_split": None,
    }
    atomic_write(folder / _INFO, json.dumps({"features": _features(columns)}).encode())
    atomic_write(folder / _STATE, json.dumps(state).encode())


def _row(episode: Episode, schema: pa.Schema) -> pa.RecordBatch:
    twice = np.array([*range(len(episode)), len(episode) - 1])
    cells: dict[str, Any] = {
        "obs": episode.observations[twice].tolist(),
        "acts": episode.actions.tolist(),
        "infos": ["{}"] * len(episode),
        "terminal": False,
        "rews": None if episode.rewards is None else episode.rewards.tolist(),
    }
    return pa.RecordBatch.from_pylist([{name: cells[name] for name in schema.names}], schema=schema)


def _nested(element: pa.DataType, n_dims: int) -> pa.DataType:
    for _ in range(n_dims):
        element = pa.list_(element)
    return element


def _features(columns: dict[str, int]) -> dict[str, Any]:
    """HuggingFace's word for the columns."""

    def nested(dtype: str, n_dims: int) -> dict[str, Any]:
        feature: dict[str, Any] = {"dtype": dtype, "_type": "Value"}
        for _ in range(n_dims):
            feature = {"feature": feature, "_type": "Sequence"}
        return feature

    words = {"infos": ("string", 1), "terminal": ("bool", 0), "rews": ("float64", 1)}
    return {name: nested(*words.get(name, ("float32", n_dims))) for name, n_dims in columns.items()}


def _data_files(folder: Path) -> list[Path]:
    path = folder / _STATE
    if not path.is_file():
        raise MissingPart(folder, f"{_STATE}: it is no folder of HuggingFace's datasets")
    try:
        names = [each["filename"] for each in json.loads(path.read_bytes())["_data_files"]]
    except (ValueError, TypeError, KeyError) as error:
        raise InvalidFile(path, f"does not say where its data is ({error!r})") from error
    if not names or not all(isinstance(name, str) and Path(name).name == name for name in names):
        raise InvalidFile(path, f"names {names!r}, not files beside it")
    for name in names:
        if not (folder / name).is_file():
            raise MissingPart(folder, name)
    return [folder / name for name in names]


def _batches(path: Path) -> Iterator[pa.RecordBatch]:
    with path.open("rb") as file:
        file.seek(-min(len(_END), path.stat().st_size), os.SEEK_END)
        if file.read() != _END:
            # A stream that ends between two of its messages would be taken for a whole one.
            raise TruncatedFile(path)
    try:
        with pa.memory_map(str(path)) as file, pa.ipc.open_stream(file) as stream:
            for batch in stream:
                batch.validate(full=True)
                yield batch
    except (pa.ArrowException, OSError, MemoryError) as error:
        raise InvalidFile(path, f"is no whole Arrow stream ({error})") from error


def _trajectory(path: Path, batch: pa.RecordBatch, index: int, n_actions: int | None) -> Episode:
    where = f"of trajectory {index}"
    observations = finite_floats(path, f"obs {where}", _with_agents(_cell(path, batch, "obs", index), 2), 3)
    acted = _cell(path, batch, "acts", index)
    if n_actions is None:
        actions = finite_floats(path, f"acts {where}", _with_agents(acted, 2), 3)
    else:
        actions = numbered_actions(path, f"acts {where}", _with_agents(acted, 1), n_actions)
    extras = {}
    if "rews" in batch.schema.names:
        extras["rewards"] = finite_doubles(path, f"rews {where}", _cell(path, batch, "rews", index), 1)
    if len(observations) != len(actions) + 1 or any(len(values) != len(actions) for values in extras.values()):
        raise InvalidFile(path, f"obs, acts and rews {where} do not have T + 1, T and T steps")
    if observations.shape[1] != actions.shape[1]:
        raise InvalidFile(path, f"obs and acts {where} are not of as many agents")
    return Episode(observations[:-1], actions, **extras)


def _with_agents(array: NDArray[Any], dims_of_one: int) -> NDArray[Any]:
    return array[:, None] if array.ndim == dims_of_one else array


def _cell(path: Path, batch: pa.RecordBatch, name: str, index: int) -> NDArray[Any]:
    """A nested list as an array: its inner lists must have one length each."""
    values: Any = batch.column(name)[index].values if pa.types.is_list(batch.schema.field(name).type) else None
    if values is None:
        raise InvalidFile(path, f"has no array in {name} of trajectory {index}")
    shape = [len(values)]
    while pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
        inner = values.flatten()
        length, rest = divmod(len(inner), max(1, len(values)))
        sizes = set(values.value_lengths().to_pylist())
        if rest or sizes - {length}:
            raise InvalidFile(path, f"has lists of unequal length in {name} of trajectory {index}")
        shape.append(length)
        values = inner
    if values.null_count:
        raise InvalidFile(path, f"lacks a number in {name} of trajectory {index}")
    return values.to_numpy(zero_copy_only=False).reshape(shape)
