"""The files of a folder of segments: the arrays and their dimensions, and the manifest.

Each array is one file of fixed-size rows, one row per segment, without header or gaps.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from mapt.errors import InvalidConfig, InvalidFile, MissingPart, NewerFile
from mapt.io import atomic_write

FORMAT = "mapt segments"
SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
#: Discrete actions are stored as uint16 indices.
MAX_DISCRETE_ACTIONS = 65_536


@dataclass(frozen=True, slots=True)
class SegmentLayout:
    """The arrays that a folder of segments stores, and their dimensions.

    Raises:
        InvalidConfig: if a value has the wrong type or is out of its range.
    """

    #: T, the longest segment; shorter ones are padded
    n_steps: int
    #: N
    n_agents: int
    #: C
    observation_dim: int
    #: A
    action_dim: int
    #: actions are one-hot; each is stored as an index
    discrete: bool = False
    #: whether true rewards are stored
    rewards: bool = False
    #: dimensions of the simulator states; 0 if they are not stored
    qpos_dim: int = 0
    qvel_dim: int = 0

    def __post_init__(self) -> None:
        for each in fields(self):
            value, minimum = getattr(self, each.name), 0 if each.name in ("qpos_dim", "qvel_dim") else 1
            if type(value) is not each.type:
                wanted = "true or false" if each.type is bool else "a whole number"
                raise InvalidConfig(f"{each.name} is {value!r}; it must be {wanted}.", each.name)
            if each.type is int and value < minimum:
                raise InvalidConfig(f"{each.name} is {value}; it must be {minimum} or more.", each.name)
        if self.discrete and self.action_dim > MAX_DISCRETE_ACTIONS:
            raise InvalidConfig(
                f"action_dim is {self.action_dim}; it must be at most {MAX_DISCRETE_ACTIONS} for discrete actions.",
                "action_dim",
            )

    @property
    def columns(self) -> dict[str, "Column"]:
        """The stored arrays by name."""
        steps = (self.n_steps, self.n_agents)
        actions = Column("<u2", steps) if self.discrete else Column("<f4", (*steps, self.action_dim))
        columns = {
            "lengths": Column("<i4", ()),
            "observations": Column("<f4", (*steps, self.observation_dim)),
            "actions": actions,
        }
        if self.rewards:
            columns["rewards"] = Column("<f8", (self.n_steps,))
        if self.qpos_dim:
            columns["qpos"] = Column("<f8", (self.n_steps, self.qpos_dim))
        if self.qvel_dim:
            columns["qvel"] = Column("<f8", (self.n_steps, self.qvel_dim))
        return columns

    def with_steps(self, n_steps: int) -> "SegmentLayout":
        """The same layout with T = `n_steps`."""
        return replace(self, n_steps=n_steps)

    @property
    def segment_bytes(self) -> int:
        """Size of one segment on disk."""
        return sum(column.row_bytes for column in self.columns.values())


@dataclass(frozen=True, slots=True)
class Column:
    """The file of one array."""

    #: little-endian numpy dtype
    dtype: str
    #: shape of one row
    shape: tuple[int, ...]

    @property
    def row_bytes(self) -> int:
        return np.dtype(self.dtype).itemsize * int(np.prod(self.shape, dtype=np.int64))


def column_path(folder: Path, name: str) -> Path:
    """The file of an array in a folder of segments."""
    return folder / f"{name}.bin"


@dataclass(frozen=True, slots=True)
class Manifest:
    """The contents of a folder. Rows beyond `n_segments` were appended but not committed."""

    layout: SegmentLayout
    n_segments: int
    #: JSON metadata of the writer: task, versions, seeds
    about: Mapping[str, Any] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Replace the manifest atomically and durably."""
        document = {
            "format": FORMAT,
            "schema_version": SCHEMA_VERSION,
            "n_segments": self.n_segments,
            "layout": asdict(self.layout),
            "about": dict(self.about),
        }
        atomic_write(folder / MANIFEST, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())

    @classmethod
    def read(cls, folder: Path) -> "Manifest":
        """Read the manifest of a folder.

        Raises:
            MissingPart: if there is none: the folder holds no segments, or its writer never committed.
            NewerFile: if a later version of this library wrote it.
            InvalidFile: if it is not a manifest of segments.
        """
        path = folder / MANIFEST
        if not path.is_file():
            raise MissingPart(folder, f"{MANIFEST}: it is not a folder of segments, or writing it was interrupted")
        try:
            document = json.loads(path.read_bytes())
            if document["format"] != FORMAT:
                raise InvalidFile(path, f"has format {document['format']!r}, not {FORMAT!r}")
            if document["schema_version"] > SCHEMA_VERSION:
                raise NewerFile(path, document["schema_version"], SCHEMA_VERSION)
            layout = SegmentLayout(**document["layout"])
            return cls(layout, _count(document["n_segments"]), dict(document["about"]))
        except InvalidFile:
            raise
        except (ValueError, TypeError, KeyError) as error:
            raise InvalidFile(path, f"is not a manifest of segments ({error})") from error


def _count(value: object) -> int:
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"n_segments is {value!r}")
    return value
