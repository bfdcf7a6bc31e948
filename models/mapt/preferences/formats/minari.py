"""Minari's datasets: one group per episode, with one more observation than there are actions.

Of several agents where observations and actions are Dict spaces with a key for each of them; agents are taken in the
natural order of their keys (agent_2 before agent_10). The simulator's states lie in `infos/qpos` and `infos/qvel`
where the dataset has them. Read and written without the library itself, which asks for the environment's own.

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
#: The version whose layout is written.
_VERSION = "0.5.4"


def read_minari(path: Path | str, *, n_actions: int | None = None, max_bytes: int = MAX_BYTES) -> Iterator[Episode]:
    """Episodes in their order, one in memory at a time. The last observation of each is left out: none acted on it.

    Args:
        path: the dataset's folder, or the folder `data` in it.
        n_actions: of a task with discrete actions: their numbers become one-hot.

    Raises:
        MissingPart: if the dataset, an episode or an array of one is not there.
        InvalidFile: if the file is cut, if arrays disagree in length, or if the agents differ in dimensions or are not
            the same in observations and actions.
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


def write_minari(path: Path | str, episodes: Iterable[Episode], *, dataset_id: str) -> None:
    """Write episodes as a dataset that Minari loads, one in memory at a time; agents are agent_0, agent_1, ...

    What each saw after its last action is not known: the last observation is there twice.

    Args:
        path: the dataset's folder; `minari.MinariDataset(path / "data")` opens it, and `minari.load_dataset` does
            where it lies at its id below Minari's own folder.
        dataset_id: as Minari asks for, for example "half-cheetah-6x1/replay-v0".

    Raises:
        AlreadyExists: if there is something at `path`.
        ShapeError: if there is no episode, or one is not like the first. Nothing is left then.
    """
    path = Path(path)
    if path.exists():
        raise AlreadyExists(path)
    data = path / "data"
    data.mkdir(parents=True)
    try:
        metadata = _write_episodes(data / _MAIN, episodes)
        atomic_write(data / _METADATA, json.dumps(metadata | {"dataset_id": dataset_id}).encode())
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise


def _write_episodes(path: Path, episodes: Iterable[Episode]) -> dict[str, Any]:
    shape: tuple[int, ...] | None = None
    n_episodes = n_steps = 0
    with h5py.File(path, "w", track_order=True) as file:
        for episode in episodes:
            found = (*episode.observations.shape[1:], episode.actions.shape[2])
            shape = shape or found
            if found != shape:
                raise ShapeError("observations", found, f"agents and dimensions of the first episode, {shape}")
            _write_episode(file.create_group(f"episode_{n_episodes}"), n_episodes, episode)
            n_episodes, n_steps = n_episodes + 1, n_steps + len(episode)
    if shape is None:
        raise ShapeError("episodes", (0,), "at least one")
    n_agents, observation_dim, action_dim = shape
    return {
        "total_episodes": n_episodes,
        "total_steps": n_steps,
        "data_format": "hdf5",
        "observation_space": json.dumps(_space(n_agents, observation_dim)),
        "action_space": json.dumps(_space(n_agents, action_dim)),
        "minari_version": _VERSION,
    }


def _write_episode(group: h5py.Group, index: int, episode: Episode) -> None:
    group.attrs["id"], group.attrs["total_steps"] = index, len(episode)
    twice = np.array([*range(len(episode)), len(episode) - 1])
    for agent in range(episode.observations.shape[1]):
        group[f"observations/agent_{agent}"] = episode.observations[twice, agent]
        group[f"actions/agent_{agent}"] = episode.actions[:, agent]
    group["rewards"] = np.zeros(len(episode)) if episode.rewards is None else episode.rewards
    group["terminations"] = np.zeros(len(episode), dtype=np.bool_)
    group["truncations"] = np.arange(len(episode)) == len(episode) - 1
    for name in ("qpos", "qvel"):
        values = episode.extras().get(name)
        if values is not None:
            group[f"infos/{name}"] = values[twice]


def _space(n_agents: int, size: int) -> dict[str, Any]:
    """Minari's word for a Dict space of unbounded Boxes, one an agent."""
    bounds = {"low": [-np.inf] * size, "high": [np.inf] * size}
    box = {"type": "Box", "dtype": "float32", "shape": [size], **bounds}
    return {"type": "Dict", "subspaces": {f"agent_{agent}": box for agent in range(n_agents)}}


def _n_episodes(folder: Path) -> int:
    path = folder / _METADATA
    if not path.is_file():
        raise MissingPart(folder, f"{_METADATA}: it is no dataset of Minari")
    try:
        metadata = json.loads(path.read_bytes())
        found, form = metadata["total_episodes"], metadata["data_format"]
    except (ValueError, TypeError, KeyError) as error:
        raise InvalidFile(path, f"is no metadata of Minari ({error!r})") from error
    if form != "hdf5":
        raise InvalidFile(path, f'keeps its data as {form!r}; only "hdf5" is read')
    if not isinstance(found, int) or found < 1:
        raise InvalidFile(path, f"has {found!r} episodes")
    return found


def _episode(file: Hdf5File, group: str, n_actions: int | None) -> Episode:
    rewards = finite_doubles(file.path, f"{group}/rewards", file.array(f"{group}/rewards", 1)[()], 1)
    extras = {"rewards": rewards}
    for name in ("qpos", "qvel"):
        place = f"{group}/infos/{name}"
        if file.is_array(place):
            # With the reset's: one more than there are actions.
            extras[name] = _first(
                file.path, place, finite_doubles(file.path, place, file.array(place, 2)[()], 2), rewards
            )
    agents = _agents(file, group)
    observations = [
        _first(file.path, place, finite_floats(file.path, place, file.array(place, 2)[()], 2), rewards)
        for place in (f"{group}/observations{agent}" for agent in agents)
    ]
    actions = [_actions(file, f"{group}/actions{agent}", n_actions) for agent in agents]
    for name, parts in (("observations", observations), ("actions", actions)):
        if {part.shape for part in parts} != {(len(rewards), parts[0].shape[1])}:
            raise InvalidFile(
                file.path, f"{group}/{name} differ in steps or dimensions from agent to agent, or from rewards"
            )
    return Episode(np.stack(observations, axis=1), np.stack(actions, axis=1), **extras)


def _first(path: Path, where: str, values: Any, rewards: Any) -> Any:
    if len(values) not in (len(rewards), len(rewards) + 1) or (
        "/observations" in where and len(values) == len(rewards)
    ):
        raise InvalidFile(path, f"{where} has {len(values)} rows for {len(rewards)} rewards")
    return values[: len(rewards)]


def _actions(file: Hdf5File, place: str, n_actions: int | None) -> FloatArray:
    if n_actions is None:
        return finite_floats(file.path, place, file.array(place, 2)[()], 2)
    return numbered_actions(file.path, place, file.array(place, 1)[()][:, None], n_actions)[:, 0]


def _agents(file: Hdf5File, group: str) -> list[str]:
    """What to put behind "observations" and "actions" for each agent."""
    if file.is_array(f"{group}/observations") and file.is_array(f"{group}/actions"):
        return [""]
    found = [file.names(f"{group}/{name}") for name in ("observations", "actions")]
    if not found[0] or found[0] != found[1]:
        raise InvalidFile(file.path, f"{group}: observations of {found[0] or 'one'} and actions of {found[1] or 'one'}")
    return [f"/{name}" for name in sorted(found[0], key=_natural)]


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
