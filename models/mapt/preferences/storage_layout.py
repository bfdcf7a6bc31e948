"""How segments lie on disk: one file of equal rows per array, and a manifest that counts the rows."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from mapt.errors import InvalidFile, MissingPart, NewerFile
from mapt.io import atomic_write

FORMAT = "mapt segments"
SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
#: The most actions that a stored index can tell apart.
MAX_DISCRETE_ACTIONS = 65_536


@dataclass(frozen=True, slots=True)
class SegmentLayout:
    """Which arrays a folder of segments keeps, and their dimensions."""

    #: T, the most steps of a segment; shorter ones are padded
    n_steps: int
    #: N
    n_agents: int
    #: C
    observation_dim: int
    #: A
    action_dim: int
    #: actions are one-hot; stored as an index each
    discrete: bool = False
    #: true rewards, one a step
    rewards: bool = False
    #: numbers in a simulator state; 0 keeps none
    qpos_dim: int = 0
    qvel_dim: int = 0

    def __post_init__(self) -> None:
        for each in fields(self):
            value, least = getattr(self, each.name), 0 if each.name in ("qpos_dim", "qvel_dim") else 1
            if type(value) is not each.type:
                raise ValueError(f"{each.name} is {value!r}")
            if each.type is int and value < least:
                raise ValueError(f"{each.name} is {value}, it must be at least {least}")
        if self.discrete and self.action_dim > MAX_DISCRETE_ACTIONS:
            raise ValueError(f"action_dim must be at most {MAX_DISCRETE_ACTIONS} where actions are discrete")

    @property
    def columns(self) -> dict[str, "Column"]:
        """Every array that is kept, by name."""
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
        """The same for segments of at most `n_steps`."""
        return replace(self, n_steps=n_steps)

    @property
    def segment_bytes(self) -> int:
        """What one segment takes on disk."""
        return sum(column.row_bytes for column in self.columns.values())


@dataclass(frozen=True, slots=True)
class Column:
    """One array of a folder: rows of this shape, one a segment, without anything between."""

    dtype: str
    #: of one row
    shape: tuple[int, ...]

    @property
    def row_bytes(self) -> int:
        return np.dtype(self.dtype).itemsize * int(np.prod(self.shape, dtype=np.int64))


def column_path(folder: Path, name: str) -> Path:
    return folder / f"{name}.bin"


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a folder holds. Rows beyond `n_segments` are the rest of a write that never ended."""

    layout: SegmentLayout
    n_segments: int
    #: where the segments come from: task, versions, seeds; anything JSON can say
    about: Mapping[str, Any] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Replace the manifest, whole or not at all, and be sure of it."""
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
        """
        Raises:
            MissingPart: if there is no manifest: no folder of segments, or a write that never got so far.
            NewerFile, InvalidFile: if it is a newer one, or none of ours.
        """
        path = folder / MANIFEST
        if not path.is_file():
            raise MissingPart(folder, f"{MANIFEST}: it is no folder of segments, or its writing never ended")
        try:
            document = json.loads(path.read_bytes())
            if document["format"] != FORMAT:
                raise InvalidFile(path, f"is of {document['format']!r}, not of {FORMAT!r}")
            if document["schema_version"] > SCHEMA_VERSION:
                raise NewerFile(path, document["schema_version"], SCHEMA_VERSION)
            layout = SegmentLayout(**document["layout"])
            return cls(layout, _count(document["n_segments"]), dict(document["about"]))
        except InvalidFile:
            raise
        except (ValueError, TypeError, KeyError) as error:
            raise InvalidFile(path, f"is no manifest of segments ({error})") from error


def _count(value: object) -> int:
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"n_segments is {value!r}")
    return value
