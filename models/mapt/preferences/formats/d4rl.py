"""D4RL's HDF5 files: the steps of all episodes in a row, with flags at the ends of episodes.

`observations` (L, D), `actions` (L, K), `rewards` (L,), `terminals` (L,), `timeouts` (L,), and `infos/qpos` and
`infos/qvel` for MuJoCo tasks. They hold one agent, unless `AgentIndices` split observations and actions.

Source: https://github.com/Farama-Foundation/D4RL, d4rl/offline_env.py.
"""

from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from mapt.errors import AlreadyExists, InvalidFile, MissingPart, ShapeError
from mapt.io import atomic_path
from mapt.preferences.dataset import FloatArray
from mapt.preferences.formats.arrays import MAX_BYTES, Hdf5File, finite_doubles, finite_floats, open_hdf5, rows
from mapt.preferences.formats.records import AgentIndices, Episode

#: Attribute added by `write_d4rl`: the number of agents whose values are concatenated.
_AGENTS = "mapt_n_agents"
#: HDF5 key and number of dimensions of each array that a file may lack.
_EXTRAS = {"rewards": ("rewards", 1), "qpos": ("infos/qpos", 2), "qvel": ("infos/qvel", 2)}


def read_d4rl(
    path: Path | str, *, agents: AgentIndices | None = None, horizon: int | None = None, max_bytes: int = MAX_BYTES
) -> Iterator[Episode]:
    """Read the episodes of a file, one in memory at a time.

    Args:
        agents: splits observations and actions between agents.
        horizon: maximum steps of an episode, for old files without `timeouts`.

    Raises:
        MissingPart: if an array is missing (`timeouts` only if `horizon` is None).
        InvalidFile: if the file is truncated, or its arrays differ in length or do not hold numbers.
        FileTooLarge: if the arrays declare more than `max_bytes`.
    """
    path = Path(path)
    with open_hdf5(path, max_bytes) as file:
        steps = D4rlSteps(file, agents)
        for first, last in pairwise(episode_bounds(path, steps, horizon)):
            yield steps.read(first, last)


class D4rlSteps:
    """The steps of an open file, read by index.

    Raises:
        MissingPart, InvalidFile, FileTooLarge: as `read_d4rl`.
    """

    def __init__(self, file: Hdf5File, agents: AgentIndices | None) -> None:
        self._path, self._agents = file.path, agents
        self._observations, self._actions = file.array("observations", 2), file.array("actions", 2)
        self._extras = {name: file.array(key, n_dims) for name, (key, n_dims) in _EXTRAS.items() if file.is_array(key)}
        self._flags = {name: file.array(name, 1) for name in ("terminals", "timeouts") if file.is_array(name)}
        self._n_agents = _n_agents(file)
        if "terminals" not in self._flags:
            raise MissingPart(file.path, "array 'terminals'")
        for data in (self._actions, *self._extras.values(), *self._flags.values()):
            if len(data) != len(self):
                raise InvalidFile(file.path, f"has {len(data)} steps in {data.name}, but {len(self)} in observations")
        if not len(self):
            raise InvalidFile(file.path, "holds no steps")

    def __len__(self) -> int:
        return len(self._observations)

    def flag(self, name: str) -> NDArray[np.bool_] | None:
        """`terminals` or `timeouts`, bool (L,); None if the file lacks it."""
        data = self._flags.get(name)
        return None if data is None else rows(data, 0, len(self)).astype(np.bool_)

    def read(self, first: int, last: int) -> Episode:
        """Read steps [first, last) as one episode."""
        where = f"of steps {first} to {last}"
        observations = finite_floats(self._path, f"observations {where}", rows(self._observations, first, last), 2)
        actions = finite_floats(self._path, f"actions {where}", rows(self._actions, first, last), 2)
        extras = {
            name: finite_doubles(self._path, f"{name} {where}", rows(data, first, last), data.ndim)
            for name, data in self._extras.items()
        }
        return Episode(*self._split(observations, actions), **extras)

    def _split(self, observations: FloatArray, actions: FloatArray) -> tuple[FloatArray, FloatArray]:
        if self._agents is not None:
            return self._agents.split(self._path, observations, actions)
        for name, flat in (("observations", observations), ("actions", actions)):
            if flat.shape[1] % self._n_agents:
                raise InvalidFile(
                    self._path,
                    f"has {flat.shape[1]} values per step in {name}, not a multiple of {self._n_agents} agents",
                )
        shape = (len(observations), self._n_agents, -1)
        return observations.reshape(shape), actions.reshape(shape)


def episode_bounds(path: Path, steps: D4rlSteps, horizon: int | None) -> list[int]:
    """The first step of each episode, then the number of steps."""
    ends, timeouts = steps.flag("terminals"), steps.flag("timeouts")
    assert ends is not None
    if timeouts is None and horizon is None:
        raise MissingPart(path, "array 'timeouts'; pass the horizon of the task instead")
    if timeouts is not None:
        ends = ends | timeouts
    bounds = [0, *(np.flatnonzero(ends) + 1).tolist(), len(steps)]
    bounds = sorted(set(bounds))
    if horizon is None:
        return bounds
    return [start for first, last in pairwise(bounds) for start in range(first, last, horizon)] + bounds[-1:]


def write_d4rl(path: Path | str, episodes: Iterable[Episode]) -> None:
    """Write episodes as a D4RL file, one in memory at a time. Each ends with a timeout.

    The values of several agents are concatenated; `read_d4rl` splits them again.

    Raises:
        AlreadyExists: if the file exists.
        ShapeError: if there is no episode, or an episode differs from the first in dimensions. No file is left.
    """
    path = Path(path)
    if path.exists():
        raise AlreadyExists(path)
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        n_episodes = 0
        for episode in episodes:
            n_episodes += 1
            file.attrs.setdefault(_AGENTS, episode.observations.shape[1])
            _append(file, "observations", episode.observations.reshape(len(episode), -1), n_episodes)
            _append(file, "actions", episode.actions.reshape(len(episode), -1), n_episodes)
            for name, (key, _) in _EXTRAS.items():
                values = episode.extras().get(name)
                if values is not None:
                    _append(file, key, values, n_episodes)
                elif key in file:
                    raise ShapeError(name, (), "an array in every episode or in none")
            ends = np.zeros(len(episode), dtype=np.bool_)
            _append(file, "terminals", ends, n_episodes)
            _append(file, "timeouts", np.arange(len(episode)) == len(episode) - 1, n_episodes)
        if not n_episodes:
            raise ShapeError("episodes", (0,), "at least one")


def _append(file: h5py.File, name: str, values: NDArray[np.generic], n_episodes: int) -> None:
    if name not in file:
        if n_episodes > 1:
            raise ShapeError(name, values.shape, "an array in every episode or in none")
        file.create_dataset(name, data=values, maxshape=(None, *values.shape[1:]), chunks=True)
        return
    data = file[name]
    assert isinstance(data, h5py.Dataset)
    if values.shape[1:] != data.shape[1:]:
        raise ShapeError(name, values.shape, f"(L, {', '.join(map(str, data.shape[1:]))}), as in the first episode")
    data.resize(len(data) + len(values), axis=0)
    data[-len(values) :] = values


def _n_agents(file: Hdf5File) -> int:
    found = file.attribute(_AGENTS)
    if found is None:
        return 1
    if not isinstance(found, int | np.integer) or found < 1:
        raise InvalidFile(file.path, f"has {_AGENTS} {found!r}")
    return int(found)
