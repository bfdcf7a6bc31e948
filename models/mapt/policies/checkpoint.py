"""Checkpoints of a learner: one safetensors file of tensors by dotted name, with a JSON description in its header."""

import json
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from mapt.errors import CheckpointMismatch, DamagedCheckpoint, InvalidConfig, NewerCheckpoint, TaskError
from mapt.policies.kernels import Adam

#: Format 1 had other names for parts of MAT's decoder.
FORMAT_VERSION = 2
#: Key of the description in the header's metadata, which maps strings to strings.
_DESCRIPTION = "mapt.policies"
#: A safetensors file starts with the length of its JSON header in this many bytes, little-endian.
_LENGTH_BYTES = 8
#: Names in format 1, as patterns, and in format 2.
_RENAMED = {
    r"^decoder\.network\.": "decoder.",
    r"^(decoder\.layers\.\d+)\.seen_norm\.": r"\1.query_norm.",
    r"^(decoder\.layers\.\d+)\.done_norm\.": r"\1.context_norm.",
    r"^(decoder\.layers\.\d+)\.among_actions\.": r"\1.self_attention.",
    r"^(decoder\.layers\.\d+)\.from_seen\.": r"\1.cross_attention.",
}


def flatten(parts: Mapping[str, Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Copies on the CPU of the tensors of each part, named "part.name"."""
    return {
        f"{part}.{name}": tensor.detach().cpu().clone().contiguous()
        for part, tensors in parts.items()
        for name, tensor in tensors.items()
    }


def unflatten(tensors: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """The inverse of `flatten`; names of earlier formats are replaced by current ones."""
    parts: dict[str, dict[str, Tensor]] = defaultdict(dict)
    for key, tensor in tensors.items():
        part, _, name = _current_name(key).partition(".")
        parts[part][name] = tensor
    return parts


def _current_name(key: str) -> str:
    for pattern, replacement in _RENAMED.items():
        key = re.sub(pattern, replacement, key)
    return key


def optimiser_state(optimisers: Sequence[Adam]) -> dict[str, Tensor]:
    """The state of several optimisers, their parameters numbered consecutively."""
    state: dict[str, Tensor] = {}
    first = 0
    for optimiser in optimisers:
        state |= optimiser.state_dict(first)
        first += len(optimiser.parameters)
    return state


def load_optimiser_state(optimisers: Sequence[Adam], state: Mapping[str, Tensor]) -> None:
    """Restore the result of `optimiser_state`; an empty mapping resets the optimisers."""
    first = 0
    for optimiser in optimisers:
        optimiser.load_state_dict(state, first)
        first += len(optimiser.parameters)


def pack(tensors: dict[str, Tensor], description: Mapping[str, object]) -> bytes:
    """Tensors and a description, as the bytes of a safetensors file."""
    header = json.dumps({"format": FORMAT_VERSION, **description}, sort_keys=True)
    return safetensors.torch.save(tensors, metadata={_DESCRIPTION: header})


@dataclass(frozen=True, slots=True)
class Description:
    """The header of a checkpoint."""

    #: name of the task
    task: str
    #: the learner's settings, from `PolicyConfig.to_dict`
    config: dict[str, object]


def describe(content: bytes) -> Description:
    """Read the header of a checkpoint.

    Raises:
        DamagedCheckpoint: if it is not a checkpoint of a learner.
        NewerCheckpoint: if a later version of this library wrote it.
    """
    try:
        length = int.from_bytes(content[:_LENGTH_BYTES], "little")
        header = json.loads(content[_LENGTH_BYTES : _LENGTH_BYTES + length])
        description = json.loads(header["__metadata__"][_DESCRIPTION])
        version, task, config = int(description["format"]), description["task"], description["config"]
    except (ValueError, KeyError, TypeError) as error:
        raise DamagedCheckpoint(repr(error)) from error
    if version > FORMAT_VERSION:
        raise NewerCheckpoint(version, FORMAT_VERSION)
    return Description(task, config)


def unpack(content: bytes, task_name: str) -> tuple[dict[str, Tensor], dict[str, object]]:
    """Read a checkpoint's tensors and the learner's settings.

    Raises:
        CheckpointError: if it is damaged, of a later format or of another task.
    """
    description = describe(content)
    if description.task != task_name:
        raise CheckpointMismatch(f"The checkpoint is of task {description.task}, not {task_name}.")
    try:
        return safetensors.torch.load(content), description.config
    except SafetensorError as error:
        raise DamagedCheckpoint(repr(error)) from error


@contextmanager
def refusing_mismatch() -> Iterator[None]:
    """Convert errors of torch and of tasks about tensors that do not fit to CheckpointMismatch.

    Raises:
        CheckpointMismatch: if a tensor is missing, surplus or of another shape.
    """
    try:
        yield
    except (KeyError, RuntimeError, ValueError, TaskError, InvalidConfig) as error:
        raise CheckpointMismatch(f"The checkpoint does not fit this learner ({error}).") from error
