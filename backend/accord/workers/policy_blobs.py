"""A policy's checkpoint in the blob store: the learner, and the steps that the next rewards look back on."""

import secrets
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load, save

from accord.store.blobs import BlobStore

_LEARNER = "learner"
_CONTEXT = "context."


@dataclass(frozen=True, slots=True)
class PolicyCheckpoint:
    """Everything that decides how training goes on."""

    #: `MappoLearner.to_bytes`
    learner: bytes
    #: `RolloutRelabeller.state_dict`; empty before the first reward version
    context: dict[str, NDArray[np.generic]]


def store_checkpoint(blobs: BlobStore, experiment_id: str, steps: int, checkpoint: PolicyCheckpoint) -> str:
    """Write a checkpoint under a key of its own; returns the key.

    Raises:
        BlobsNotWritable: if the blobs are read-only or full.
    """
    arrays = {_LEARNER: np.frombuffer(checkpoint.learner, dtype=np.uint8)}
    arrays |= {_CONTEXT + name: np.ascontiguousarray(array) for name, array in checkpoint.context.items()}
    # A restarted worker may come to the same step again, with other bytes.
    key = f"policies/{experiment_id}/{steps:012d}-{secrets.token_hex(4)}.safetensors"
    blobs.put(key, save(arrays))
    return key


def read_checkpoint(blobs: BlobStore, key: str) -> PolicyCheckpoint:
    """Raises BlobMissing."""
    arrays = load(blobs.read(key))
    context = {name.removeprefix(_CONTEXT): array for name, array in arrays.items() if name != _LEARNER}
    return PolicyCheckpoint(arrays[_LEARNER].tobytes(), context)
