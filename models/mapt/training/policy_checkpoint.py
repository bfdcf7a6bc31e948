"""The file in which the state of a policy's training is stored. Reading it needs no torch."""

import json
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from mapt.errors import DamagedCheckpoint
from mapt.policies.header import describe

_LEARNER = "learner"
_PROGRESS = "progress"
_CONTEXT = "context."


@dataclass(frozen=True, slots=True)
class PolicyCheckpoint:
    """The state that training resumes from."""

    #: `Learner.to_bytes`
    learner: bytes
    #: `RolloutRelabeller.state_dict`; empty before the first reward version
    context: dict[str, NDArray[np.generic]]
    #: JSON-ready state of the run, such as its iteration
    progress: dict[str, object] = field(default_factory=dict[str, object])

    def to_bytes(self) -> bytes:
        """Encode as one safetensors file; equal checkpoints give equal bytes."""
        arrays = {_LEARNER: np.frombuffer(self.learner, dtype=np.uint8)}
        # `ascontiguousarray` would turn a scalar into an array of one number.
        arrays |= {_CONTEXT + name: np.asarray(array, order="C") for name, array in self.context.items()}
        if self.progress:
            arrays[_PROGRESS] = np.frombuffer(json.dumps(self.progress, sort_keys=True).encode(), dtype=np.uint8)
        return save(arrays)

    @classmethod
    def from_bytes(cls, content: bytes) -> "PolicyCheckpoint":
        """Decode the result of `to_bytes`.

        Raises:
            DamagedCheckpoint: if it is damaged, or not a checkpoint.
        """
        try:
            arrays = load(content)
            learner, progress = arrays[_LEARNER].tobytes(), arrays.get(_PROGRESS)
            run_state = {} if progress is None else json.loads(progress.tobytes())
        except (SafetensorError, KeyError, ValueError) as error:
            raise DamagedCheckpoint(repr(error)) from error
        context = {name.removeprefix(_CONTEXT): array for name, array in arrays.items() if name.startswith(_CONTEXT)}
        return cls(learner, context, run_state)


def learner_of(content: bytes) -> bytes:
    """The bytes of the learner in a checkpoint of a run, or in a file of `Learner.save`.

    Raises:
        DamagedCheckpoint: if they are neither.
        NewerCheckpoint: if a later version of this library wrote them.
    """
    try:
        describe(content)
    except DamagedCheckpoint:
        learner = PolicyCheckpoint.from_bytes(content).learner
        describe(learner)
        return learner
    return content
