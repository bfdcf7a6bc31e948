"""Minari datasets: an HDF5 file with one group per episode, with one more observation than actions.

In a multi-agent dataset, observations and actions are Dict spaces with a key per agent; agents are sorted in natural
order (agent_2 before agent_10). Simulator states are in `infos/qpos` and `infos/qvel`, if the dataset has them. The
minari package is not needed; it would require the dataset's environment to be installed.

Source: https://minari.farama.org, "Dataset standards"; minari 0.5.4.
"""

import json
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mapt.errors import AlreadyExists, InvalidFile, MissingPart, ShapeError
from mapt.io import atomic_write
from mapt.preferences.dataset import FloatArray
from mapt.preferences.formats.arrays import (
    MAX_BYTES,
    Hdf5File,
    finite_doubles,
    finite_floats,
    numbered_actions,
    open_hdf5,
)
from mapt.preferences.formats.records import Episode

_MAIN, _METADATA = "main_data.hdf5", "metadata.json"
#: Version of Minari whose layout is written.
_VERSION = "0.5.4"


def read_minari(path: Path | str, *, n_actions: int | None = None, max_bytes: int = MAX_BYTES) -> Iterator[Episode]:
    """Read the episodes of a dataset, one in memory at a time, without the observation after the last action.

    Args:
        path: the folder of the dataset, or the folder `data` in it.
        n_actions: number of discrete actions, to convert indices to one-hot; None for continuous actions.

    Raises:
        MissingPart: if the dataset, an episode or an array is missing.
        InvalidFile: if the file is truncated, if arrays differ in length, or if agents differ in dimensions or between
            observations and actions.
        FileTooLarge: if the arrays declare more than `max_bytes`.
    """
    folder = Path(path)
    folder = folder / "data" if (folder / "data").is_dir() else folder
    file_path, n_episodes = folder / _MAIN, _n_episodes(folder)
    if not file_path.is_file():
        raise MissingPart(folder, _MAIN)
    with open_hdf5(file_path, max_bytes) as file:
        for index in range(n_episodes):
            group = f"episode_{index}"
            if not file.names(group):
                raise MissingPart(file_path, group)
            yield _episode(file, group, n_actions)


def write_minari(path: Path | str, episodes: Iterable[Episode], *, dataset_id: str, discrete: bool = False) -> None:
    """Write episodes as a dataset that Minari loads, one in memory at a time, with agents agent_0, agent_1, ...

    The observation after the last action is unknown; the last observation is repeated in its place.

    Args:
        path: the folder of the dataset. `minari.MinariDataset(path / "data")` opens it; so does `minari.load_dataset`
            if it is at `dataset_id` in Minari's folder.
        dataset_id: Minari's identifier, for example "half-cheetah-6x1/replay-v0".
        discrete: actions are one-hot, to be written as indices of a Discrete space for each agent.

    Raises:
        AlreadyExists: if `path` exists.
        ShapeError: if there is no episode, or an episode differs from the first in dimensions. Nothing is left.
        NotOneHot: if discrete actions are not one-hot. Nothing is left.
    """
    path = Path(path)
    if path.exists():
        raise AlreadyExists(path)
    data = path / "data"
    data.mkdir(parents=True)
    try:
        metadata = _write_episodes(data / _MAIN, episodes, discrete)
        atomic_write(data / _METADATA, json.dumps(metadata | {"dataset_id": dataset_id}).encode())
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise


def _write_episodes(path: Path, episodes: Iterable[Episode], discrete: bool) -> dict[str, Any]:
    shape: tuple[int, ...] | None = None
    n_episodes = n_steps = 0
    with h5py.File(path, "w", track_order=True) as file:
        for episode in episodes:
            found = (*episode.observations.shape[1:], episode.actions.shape[2])
            shape = shape or found
            if found != shape:
                raise ShapeError("observations", found, f"agents and dimensions as in the first episode, {shape}")
            _write_episode(file.create_group(f"episode_{n_episodes}"), n_episodes, episode, discrete)
            n_episodes, n_steps = n_episodes + 1, n_steps + len(episode)
    if shape is None:
        raise ShapeError("episodes", (0,), "at least one")
    n_agents, observation_dim, action_dim = shape
    return {
        "total_episodes": n_episodes,
        "total_steps": n_steps,
        "data_format": "hdf5",
        "observation_space": json.dumps(_space(n_agents, _box(observation_dim))),
        "action_space": json.dumps(_space(n_agents, _discrete(action_dim) if discrete else _box(action_dim))),
        "minari_version": _VERSION,
    }


def _write_episode(group: h5py.Group, index: int, episode: Episode, discrete: bool) -> None:
    group.attrs["id"], group.attrs["total_steps"] = index, len(episode)
    states = episode.steps_with_last_twice
    actions = episode.action_indices() if discrete else episode.actions
    for agent in range(episode.observations.shape[1]):
        group[f"observations/agent_{agent}"] = episode.observations[states, agent]
        group[f"actions/agent_{agent}"] = actions[:, agent]
    group["rewards"] = np.zeros(len(episode)) if episode.rewards is None else episode.rewards
    group["terminations"] = np.zeros(len(episode), dtype=np.bool_)
    group["truncations"] = np.arange(len(episode)) == len(episode) - 1
    for name in ("qpos", "qvel"):
        values = episode.extras().get(name)
        if values is not None:
            group[f"infos/{name}"] = values[states]


def _space(n_agents: int, of_agent: dict[str, Any]) -> dict[str, Any]:
    """Minari's JSON of a Dict space with the same space for each agent."""
    return {"type": "Dict", "subspaces": {f"agent_{agent}": of_agent for agent in range(n_agents)}}


def _box(size: int) -> dict[str, Any]:
    """Minari's JSON of an unbounded Box."""
    bounds = {"low": [-np.inf] * size, "high": [np.inf] * size}
    return {"type": "Box", "dtype": "float32", "shape": [size], **bounds}


def _discrete(n: int) -> dict[str, Any]:
    """Minari's JSON of a Discrete space."""
    return {"type": "Discrete", "dtype": "int64", "start": 0, "n": n}


def _n_episodes(folder: Path) -> int:
    path = folder / _METADATA
    if not path.is_file():
        raise MissingPart(folder, f"{_METADATA}: it is not a Minari dataset")
    try:
        metadata = json.loads(path.read_bytes())
        found, form = metadata["total_episodes"], metadata["data_format"]
    except (ValueError, TypeError, KeyError) as error:
        raise InvalidFile(path, f"is not Minari metadata ({error!r})") from error
    if form != "hdf5":
        raise InvalidFile(path, f'has data_format {form!r}; only "hdf5" can be read')
    if not isinstance(found, int) or found < 1:
        raise InvalidFile(path, f"has {found!r} episodes")
    return found


def _episode(file: Hdf5File, group: str, n_actions: int | None) -> Episode:
    rewards = finite_doubles(file.path, f"{group}/rewards", file.array(f"{group}/rewards", 1)[()], 1)
    extras = {"rewards": rewards}
    for name in ("qpos", "qvel"):
        key = f"{group}/infos/{name}"
        if file.is_array(key):
            # Includes the state after the reset: one more than actions.
            extras[name] = _first(file.path, key, finite_doubles(file.path, key, file.array(key, 2)[()], 2), rewards)
    agents = _agents(file, group)
    observations = [
        _first(file.path, key, finite_floats(file.path, key, file.array(key, 2)[()], 2), rewards)
        for key in (f"{group}/observations{agent}" for agent in agents)
    ]
    actions = [_actions(file, f"{group}/actions{agent}", n_actions) for agent in agents]
    for name, parts in (("observations", observations), ("actions", actions)):
        if {part.shape for part in parts} != {(len(rewards), parts[0].shape[1])}:
            raise InvalidFile(
                file.path,
                f"has {name} in {group} that differ in steps or dimensions between agents, or in steps from rewards",
            )
    return Episode(np.stack(observations, axis=1), np.stack(actions, axis=1), **extras)


def _first(path: Path, where: str, values: Any, rewards: Any) -> Any:
    if len(values) not in (len(rewards), len(rewards) + 1) or (
        "/observations" in where and len(values) == len(rewards)
    ):
        raise InvalidFile(path, f"has {len(values)} rows in {where} for {len(rewards)} rewards")
    return values[: len(rewards)]


def _actions(file: Hdf5File, key: str, n_actions: int | None) -> FloatArray:
    if n_actions is None:
        return finite_floats(file.path, key, file.array(key, 2)[()], 2)
    actions = file.array(key, 1 if file.n_dims(key) == 1 else 2)[()]
    return numbered_actions(file.path, key, actions[:, None], n_actions)[:, 0]


def _agents(file: Hdf5File, group: str) -> list[str]:
    """The suffix of "observations" and "actions" in the path of each agent's arrays."""
    if file.is_array(f"{group}/observations") and file.is_array(f"{group}/actions"):
        return [""]
    found = [file.names(f"{group}/{name}") for name in ("observations", "actions")]
    if not found[0] or found[0] != found[1]:
        raise InvalidFile(file.path, f"has observations of {found[0]} but actions of {found[1]} in {group}")
    return [f"/{name}" for name in sorted(found[0], key=_natural)]


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
