"""A policy's checkpoint: the learner, the steps that the next rewards look back on, and how far the run is."""

import json
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from mapt.policies import InvalidCheckpoint

_LEARNER = "learner"
_PROGRESS = "progress"
_CONTEXT = "context."


@dataclass(frozen=True, slots=True)
class PolicyCheckpoint:
    """Everything that decides how training goes on."""

    #: `Learner.to_bytes`
    learner: bytes
    #: `RolloutRelabeller.state_dict`; empty before the first reward version
    context: dict[str, NDArray[np.generic]]
    #: whatever the run notes of itself, for JSON
    progress: dict[str, object] = field(default_factory=dict[str, object])

    def to_bytes(self) -> bytes:
        """One safetensors file; equal checkpoints give equal bytes."""
        arrays = {_LEARNER: np.frombuffer(self.learner, dtype=np.uint8)}
        arrays |= {_CONTEXT + name: np.ascontiguousarray(array) for name, array in self.context.items()}
        if self.progress:
            arrays[_PROGRESS] = np.frombuffer(json.dumps(self.progress, sort_keys=True).encode(), dtype=np.uint8)
        return save(arrays)

    @classmethod
    def from_bytes(cls, content: bytes) -> "PolicyCheckpoint":
        """What `to_bytes` wrote.

        Raises:
            mapt.policies.InvalidCheckpoint: if it is damaged, or another file.
        """
        try:
            arrays = load(content)
            learner, progress = arrays[_LEARNER].tobytes(), arrays.get(_PROGRESS)
            noted = {} if progress is None else json.loads(progress.tobytes())
        except (SafetensorError, KeyError, ValueError) as error:
            raise InvalidCheckpoint("This is no checkpoint of a run, or it is damaged.") from error
        context = {name.removeprefix(_CONTEXT): array for name, array in arrays.items() if name.startswith(_CONTEXT)}
        return cls(learner, context, noted)
