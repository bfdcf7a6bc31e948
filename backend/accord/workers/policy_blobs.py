"""A policy's checkpoint in the blob store."""

import secrets

from accord.store.blobs import BlobStore
from mapt.runs.checkpoint import PolicyCheckpoint


def store_checkpoint(blobs: BlobStore, experiment_id: str, steps: int, checkpoint: PolicyCheckpoint) -> str:
    """Write a checkpoint under a key of its own; returns the key.

    Raises:
        BlobsNotWritable: if the blobs are read-only or full.
    """
    # A restarted worker may come to the same step again, with other bytes.
    key = f"policies/{experiment_id}/{steps:012d}-{secrets.token_hex(4)}.safetensors"
    blobs.put(key, checkpoint.to_bytes())
    return key


def read_checkpoint(blobs: BlobStore, key: str) -> PolicyCheckpoint:
    """Raises BlobMissing, mapt.policies.InvalidCheckpoint."""
    return PolicyCheckpoint.from_bytes(blobs.read(key))
