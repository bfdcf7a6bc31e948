"""The description in the header of a learner's checkpoint. Reading it needs no torch."""

import json
from dataclasses import dataclass

from mapt.errors import DamagedCheckpoint, NewerCheckpoint

#: Format 1 had other names for parts of MAT's decoder.
FORMAT_VERSION = 2
#: Key of the description in the header's metadata, which maps strings to strings.
DESCRIPTION_KEY = "mapt.policies"
#: A safetensors file starts with the length of its JSON header in this many bytes, little-endian.
_LENGTH_BYTES = 8
#: Statistics of the observations, (N, 1, C): of actors, and of mat's encoder.
_OBSERVATION_STATISTICS = ("actor.normaliser.mean", "normaliser.mean")


@dataclass(frozen=True, slots=True)
class Description:
    """The header of a checkpoint."""

    #: name of the task
    task: str
    #: the learner's settings, from `PolicyConfig.to_dict`
    config: dict[str, object]
    #: numbers that each agent observes, C
    observation_dim: int


def describe(content: bytes) -> Description:
    """Read the header of a checkpoint.

    Raises:
        DamagedCheckpoint: if it is not a checkpoint of a learner.
        NewerCheckpoint: if a later version of this library wrote it.
    """
    try:
        length = int.from_bytes(content[:_LENGTH_BYTES], "little")
        header = json.loads(content[_LENGTH_BYTES : _LENGTH_BYTES + length])
        description = json.loads(header["__metadata__"][DESCRIPTION_KEY])
        version, task, config = int(description["format"]), description["task"], description["config"]
        dims = [header[name]["shape"][-1] for name in _OBSERVATION_STATISTICS if name in header]
    except (ValueError, KeyError, TypeError) as error:
        raise DamagedCheckpoint(repr(error)) from error
    if version > FORMAT_VERSION:
        raise NewerCheckpoint(version, FORMAT_VERSION)
    if not dims:
        raise DamagedCheckpoint("no statistics of observations")
    return Description(task, config, dims[0])
