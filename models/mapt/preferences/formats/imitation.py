"""Files of imitation 1.0: the pickled `PreferenceDataset`, and trajectories saved by HuggingFace datasets.

A trajectory or fragment has `obs` (T + 1, N, C), `acts` (T, N, A), `rews` (T,), `infos` and `terminal`; with one agent,
`obs` (T + 1, C) and `acts` (T, A), or indices (T,) of discrete actions. The dict of a step in the `infos` of a fragment
may have `qpos` and `qvel`: the simulator's state before the action, as `infos/qpos` of D4RL. A preference is the
probability that the first fragment is preferred, as here; there are no skips. Saved trajectories are a folder with an
Arrow stream, one row per trajectory, which pyarrow reads without the datasets package.

Sources: https://github.com/HumanCompatibleAI/imitation, algorithms/preference_comparisons.py, data/types.py and
data/huggingface_utils.py; `save_to_disk` of datasets.
"""

import json
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
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
#: of a MuJoCo simulation, in the dicts of `infos`
_STATES = ("qpos", "qvel")
_KNOWN = "1 (first preferred), 0 (second preferred), 0.5 (equal), or a probability between"


def read_imitation(path: Path | str, *, n_actions: int | None = None, max_bytes: int = MAX_BYTES) -> Comparisons:
    """Read a pickled `PreferenceDataset`.

    Args:
        n_actions: number of discrete actions, to convert indices to one-hot; None for continuous actions.

    Raises:
        InvalidFile: for the first fragment that does not follow the format; see also `load_pickle`.
        UnknownLabel: for a preference that is not a probability.
        ShapeError: if the fragments differ in agents or dimensions.
    """
    path = Path(path)
    found = load_pickle(path, (_DATASET, _FRAGMENT), max_bytes=max_bytes)
    if not isinstance(found, Record) or found.name != _DATASET:
        raise InvalidFile(path, "is not a PreferenceDataset of imitation")
    labels = numbers(path, "preferences", _part(path, "dataset", found, "preferences"), 1).astype(np.float32)
    for index, label in enumerate(labels.tolist()):
        if not 0 <= label <= 1:
            raise UnknownLabel(path, index, label, _KNOWN)
    sides = [_side(path, found, name, len(labels), n_actions) for name in ("fragments1", "fragments2")]
    # States of some segments only would give some pairs half of their clips.
    lacking: dict[str, None] = {
        name: None for name in _STATES if any(name not in episode.extras() for episode in chain(*sides))
    }
    sides = [[replace(episode, **lacking) for episode in side] for side in sides]
    first, second = map(_segments, sides)
    return Comparisons.of_pairs(first, second, labels)


def write_imitation(path: Path | str, comparisons: Comparisons, *, discrete: bool = False) -> None:
    """Write comparisons for `PreferenceDataset.load`, without skips.

    The observation after the last action is unknown; the last observation is repeated in its place. Unknown rewards
    are written as 0. Known simulator states are in `infos`.

    Args:
        discrete: actions are one-hot, to be written as indices (T, N).

    Raises:
        AlreadyExists: if the file exists.
        NotOneHot: if discrete actions are not one-hot. No file is left.
    """
    labelled = ~np.isnan(comparisons.labels)
    pairs = comparisons.pairs[labelled]

    def fragments(side: int) -> Iterator[Record]:
        for segment in pairs[:, side].tolist():
            (episode,) = episodes_of(comparisons.records.take([segment]))
            yield _fragment(episode, discrete)

    dataset = {
        "fragments1": fragments(0),
        "fragments2": fragments(1),
        "max_size": None,
        "preferences": comparisons.labels[labelled],
    }
    write_pickle(Path(path), Record(_DATASET, dataset))


def _fragment(episode: Episode, discrete: bool) -> Record:
    rewards = np.zeros(len(episode)) if episode.rewards is None else episode.rewards
    fields = {
        "obs": episode.observations[episode.steps_with_last_twice],
        "acts": episode.action_indices() if discrete else episode.actions,
        "infos": _infos(episode),
        "terminal": False,
    }
    return Record(_FRAGMENT, fields | {"rews": rewards})


def _infos(episode: Episode) -> NDArray[Any] | None:
    """A dict for each step, (T,), with the simulator's state before the action; None if it is not known."""
    states = {name: values for name, values in episode.extras().items() if name in _STATES}
    if not states:
        return None
    infos = np.empty(len(episode), dtype=object)
    infos[:] = [{name: values[step] for name, values in states.items()} for step in range(len(episode))]
    return infos


def _states(path: Path, where: str, infos: object, n_steps: int) -> dict[str, NDArray[np.float64]]:
    """Those of `qpos` (T, nq) and `qvel` (T, nv) that every step of a fragment's `infos` has.

    Raises:
        InvalidFile: if they are not vectors of numbers, or differ in length.
    """
    steps = infos.tolist() if isinstance(infos, np.ndarray) else infos
    if not isinstance(steps, list) or len(steps) != n_steps or not all(isinstance(step, dict) for step in steps):
        return {}
    return {
        name: finite_doubles(path, f"{name} in infos of {where}", [step[name] for step in steps], 2)
        for name in _STATES
        if all(name in step for step in steps)
    }


def _side(path: Path, dataset: Record, name: str, n_pairs: int, n_actions: int | None) -> list[Episode]:
    fragments = _part(path, "dataset", dataset, name)
    if not isinstance(fragments, list) or len(fragments) != n_pairs or not fragments:
        raise InvalidFile(path, f"has no list of {n_pairs} fragments, one per preference, in {name}")
    return [_episode(path, f"{name}[{index}]", each, n_actions) for index, each in enumerate(fragments)]


def _segments(episodes: Sequence[Episode]) -> SegmentRecords:
    longest = max(len(episode) for episode in episodes)
    return concatenate(list(cut_segments(episodes, longest, keep_short=True)))


def _episode(path: Path, where: str, fragment: object, n_actions: int | None) -> Episode:
    if not isinstance(fragment, Record) or fragment.name != _FRAGMENT:
        raise InvalidFile(path, f"has no TrajectoryWithRew in {where}")
    observed, acted, rewarded = (_part(path, where, fragment, name) for name in ("obs", "acts", "rews"))
    episode = _checked_episode(path, where, (observed, acted, rewarded), n_actions)
    return replace(episode, **_states(path, where, fragment.fields.get("infos"), len(episode)))


def _checked_episode(
    path: Path, where: str, arrays: tuple[object, object, object | None], n_actions: int | None
) -> Episode:
    """An episode without the last observation.

    Args:
        arrays: `obs`, `acts` and `rews`, or None for unknown rewards.

    Raises:
        InvalidFile: if they are not arrays of numbers of T + 1, T and T steps, or differ in agents.
    """
    observed, acted, rewarded = arrays
    observations = finite_floats(path, f"obs of {where}", _with_agents(path, where, observed, 2), 3)
    if n_actions is None:
        actions = finite_floats(path, f"acts of {where}", _with_agents(path, where, acted, 2), 3)
    else:
        actions = numbered_actions(path, f"acts of {where}", _with_agents(path, where, acted, 1), n_actions)
    rewards = None if rewarded is None else finite_doubles(path, f"rews of {where}", rewarded, 1)
    n_steps = len(actions)
    if len(observations) != n_steps + 1 or (rewards is not None and len(rewards) != n_steps):
        found = "no" if rewards is None else len(rewards)
        raise InvalidFile(path, f"has {len(observations)} obs, {n_steps} acts and {found} rews in {where}")
    if observations.shape[1] != actions.shape[1]:
        raise InvalidFile(path, f"has obs of {observations.shape[1]} agents and acts of {actions.shape[1]} in {where}")
    return Episode(observations[:-1], actions, rewards)


def _with_agents(path: Path, where: str, values: object, single_agent_dims: int) -> NDArray[Any]:
    """Convert to an array, with an agent axis if it has the dimensions of a single agent."""
    array = as_array(path, where, values)
    return array[:, None] if array.ndim == single_agent_dims else array


def _part(path: Path, where: str, record: Record, name: str) -> Any:
    if name not in record.fields:
        raise MissingPart(path, f"{name!r} in {where}")
    return record.fields[name]


#: Limit on the size of an Arrow file.
MAX_ARROW_BYTES = 16 << 30
#: The end-of-stream marker of an Arrow stream.
_END = b"\xff\xff\xff\xff\0\0\0\0"
_STATE, _INFO = "state.json", "dataset_info.json"


def read_imitation_trajectories(
    path: Path | str, *, n_actions: int | None = None, max_bytes: int = MAX_ARROW_BYTES
) -> Iterator[Episode]:
    """Read saved trajectories, one Arrow batch in memory at a time, without their last observations.

    Args:
        path: the folder written by `imitation.data.serialize.save`.
        n_actions: number of discrete actions, to convert indices to one-hot; None for continuous actions.

    Raises:
        MissingPart: if a file or a column is missing.
        FileTooLarge: if a file has more than `max_bytes`.
        InvalidFile: if a file is truncated, or a trajectory does not follow the format.
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


def write_imitation_trajectories(path: Path | str, episodes: Iterable[Episode], *, discrete: bool = False) -> None:
    """Write episodes for `imitation.data.serialize.load`, one in memory at a time.

    The observation after the last action is unknown; the last observation is repeated in its place.

    Args:
        discrete: actions are one-hot, to be written as indices (T, N).

    Raises:
        AlreadyExists: if `path` exists.
        ShapeError: if there is no episode, or only some episodes have rewards. Nothing is left.
        NotOneHot: if discrete actions are not one-hot. Nothing is left.
    """
    folder = Path(path)
    if folder.exists():
        raise AlreadyExists(folder)
    folder.mkdir(parents=True)
    try:
        _write_trajectories(folder, episodes, discrete)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _write_trajectories(folder: Path, episodes: Iterable[Episode], discrete: bool) -> None:
    parts = iter(episodes)
    first = next(parts, None)
    if first is None:
        raise ShapeError("episodes", (0,), "at least one")
    columns = {"obs": 3, "acts": 2 if discrete else 3, "infos": 0, "terminal": 0} | (
        {} if first.rewards is None else {"rews": 1}
    )
    types = {"infos": pa.list_(pa.string()), "terminal": pa.bool_(), "rews": pa.list_(pa.float64())}
    if discrete:
        types["acts"] = _nested(pa.int64(), 2)
    schema = pa.schema([(name, types.get(name) or _nested(pa.float32(), dims)) for name, dims in columns.items()])
    name = "data-00000-of-00001.arrow"
    with pa.OSFile(str(folder / name), "wb") as file, pa.ipc.new_stream(file, schema) as stream:
        stream.write_batch(_row(first, schema, discrete))
        for episode in parts:
            if (episode.rewards is None) != (first.rewards is None):
                raise ShapeError("rewards", (), "an array in every episode or in none")
            stream.write_batch(_row(episode, schema, discrete))
    state = {
        "_data_files": [{"filename": name}],
        "_fingerprint": secrets.token_hex(8),
        "_format_columns": None,
        "_format_kwargs": {},
        "_format_type": None,
        "_output_all_columns": False,
        "_split": None,
    }
    atomic_write(folder / _INFO, json.dumps({"features": _features(columns, discrete)}).encode())
    atomic_write(folder / _STATE, json.dumps(state).encode())


def _row(episode: Episode, schema: pa.Schema, discrete: bool) -> pa.RecordBatch:
    cells: dict[str, Any] = {
        "obs": episode.observations[episode.steps_with_last_twice].tolist(),
        "acts": (episode.action_indices() if discrete else episode.actions).tolist(),
        "infos": ["{}"] * len(episode),
        "terminal": False,
        "rews": None if episode.rewards is None else episode.rewards.tolist(),
    }
    return pa.RecordBatch.from_pylist([{name: cells[name] for name in schema.names}], schema=schema)


def _nested(element: pa.DataType, n_dims: int) -> pa.DataType:
    for _ in range(n_dims):
        element = pa.list_(element)
    return element


def _features(columns: dict[str, int], discrete: bool) -> dict[str, Any]:
    """HuggingFace's JSON description of the columns."""

    def nested(dtype: str, n_dims: int) -> dict[str, Any]:
        feature: dict[str, Any] = {"dtype": dtype, "_type": "Value"}
        for _ in range(n_dims):
            feature = {"feature": feature, "_type": "Sequence"}
        return feature

    types = {"infos": ("string", 1), "terminal": ("bool", 0), "rews": ("float64", 1)}
    if discrete:
        types["acts"] = ("int64", 2)
    return {name: nested(*types.get(name, ("float32", n_dims))) for name, n_dims in columns.items()}


def _data_files(folder: Path) -> list[Path]:
    path = folder / _STATE
    if not path.is_file():
        raise MissingPart(folder, f"{_STATE}: it is not a folder of HuggingFace datasets")
    try:
        names = [each["filename"] for each in json.loads(path.read_bytes())["_data_files"]]
    except (ValueError, TypeError, KeyError) as error:
        raise InvalidFile(path, f"does not list its data files ({error!r})") from error
    if not names or not all(isinstance(name, str) and Path(name).name == name for name in names):
        raise InvalidFile(path, f"lists {names!r}, which are not files in its folder")
    for name in names:
        if not (folder / name).is_file():
            raise MissingPart(folder, name)
    return [folder / name for name in names]


def _batches(path: Path) -> Iterator[pa.RecordBatch]:
    with path.open("rb") as file:
        file.seek(-min(len(_END), path.stat().st_size), os.SEEK_END)
        if file.read() != _END:
            # pyarrow accepts a stream that is truncated between two messages.
            raise TruncatedFile(path)
    try:
        with pa.memory_map(str(path)) as file, pa.ipc.open_stream(file) as stream:
            for batch in stream:
                batch.validate(full=True)
                yield batch
    except (pa.ArrowException, OSError, MemoryError) as error:
        raise InvalidFile(path, f"is not a complete Arrow stream ({error})") from error


def _trajectory(path: Path, batch: pa.RecordBatch, index: int, n_actions: int | None) -> Episode:
    rewards = _cell(path, batch, "rews", index) if "rews" in batch.schema.names else None
    observed, acted = (_cell(path, batch, name, index) for name in ("obs", "acts"))
    return _checked_episode(path, f"trajectory {index}", (observed, acted, rewards), n_actions)


def _cell(path: Path, batch: pa.RecordBatch, name: str, index: int) -> NDArray[Any]:
    """Convert a nested list to an array. Raises InvalidFile for ragged lists and nulls."""
    values: Any = batch.column(name)[index].values if pa.types.is_list(batch.schema.field(name).type) else None
    if values is None:
        raise InvalidFile(path, f"has no array in {name} of trajectory {index}")
    shape = [len(values)]
    while pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
        inner = values.flatten()
        length, rest = divmod(len(inner), max(1, len(values)))
        sizes = set(values.value_lengths().to_pylist())
        if rest or sizes - {length}:
            raise InvalidFile(path, f"has lists of different lengths in {name} of trajectory {index}")
        shape.append(length)
        values = inner
    if values.null_count:
        raise InvalidFile(path, f"has a null value in {name} of trajectory {index}")
    return values.to_numpy(zero_copy_only=False).reshape(shape)
