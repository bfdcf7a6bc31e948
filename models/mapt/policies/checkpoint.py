"""A learner as one safetensors file: tensors by dotted name, and a JSON description in its header. No pickle."""

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from mapt.errors import CheckpointMismatch, DamagedCheckpoint, InvalidConfig, NewerCheckpoint, TaskError

FORMAT_VERSION = 1
#: Key of the description in the header's metadata, which maps strings to strings.
_DESCRIPTION = "mapt.policies"
#: A safetensors file starts with the length of its JSON header in this many bytes, little-endian.
_LENGTH_BYTES = 8


def flatten(parts: Mapping[str, Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Copies on the CPU of the tensors of each part, as "part.name"."""
    return {
        f"{part}.{name}": tensor.detach().cpu().clone().contiguous()
        for part, tensors in parts.items()
        for name, tensor in tensors.items()
    }


def unflatten(tensors: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """The parts that `flatten` joined."""
    parts: dict[str, dict[str, Tensor]] = defaultdict(dict)
    for key, tensor in tensors.items():
        part, _, name = key.partition(".")
        parts[part][name] = tensor
    return parts


def pack(tensors: dict[str, Tensor], description: Mapping[str, object]) -> bytes:
    """Tensors and a description, as the bytes of a safetensors file."""
    header = json.dumps({"format": FORMAT_VERSION, **description}, sort_keys=True)
    return safetensors.torch.save(tensors, metadata={_DESCRIPTION: header})


@dataclass(frozen=True, slots=True)
class Description:
    """What a checkpoint says of itself."""

    #: name of the task
    task: str
    #: the learner's settings, as `PolicyConfig.to_dict` gave them
    config: dict[str, object]


def describe(content: bytes) -> Description:
    """The description in a checkpoint's header.

    Raises:
        DamagedCheckpoint: if it is not a checkpoint of a learner.
        NewerCheckpoint: if a later version of this library wrote it.
    """
    try:
        length = int.from_bytes(content[:_LENGTH_BYTES], "little")
        header = json.loads(content[_LENGTH_BYTES : _LENGTH_BYTES + length])
        description = json.loads(header["__metadata__"][_DESCRIPTION])
        version, task, config = description["format"], description["task"], description["config"]
    except (ValueError, KeyError, TypeError) as error:
        raise DamagedCheckpoint(repr(error)) from error
    if version != FORMAT_VERSION:
        raise NewerCheckpoint(version, FORMAT_VERSION)
    return Description(task, config)


def unpack(content: bytes, task_name: str) -> tuple[dict[str, Tensor], dict[str, object]]:
    """Tensors and the learner's settings.

    Raises:
        CheckpointError: if it is damaged, of another format or of another task.
    """
    description = describe(content)
    if description.task != task_name:
        raise CheckpointMismatch(f"The checkpoint is of {description.task}, not of {task_name}.")
    try:
        return safetensors.torch.load(content), description.config
    except SafetensorError as error:
        raise DamagedCheckpoint(repr(error)) from error


@contextmanager
def refusing_mismatch() -> Iterator[None]:
    """Raise CheckpointMismatch for the errors of torch and tasks about tensors that do not fit.

    Raises:
        CheckpointMismatch: if a tensor is missing, surplus or of another shape.
    """
    try:
        yield
    except (KeyError, RuntimeError, ValueError, TaskError, InvalidConfig) as error:
        raise CheckpointMismatch(f"The checkpoint does not fit this learner: {error}") from error
