"""Reward models in the blob store: weights, and beside them the card that describes and checks them."""

from collections.abc import Mapping

from accord.domain.ids import new_id
from accord.store.blobs import BlobStore
from mapt.rewards.base import RewardModel
from mapt.rewards.checkpoints import load_reward_model, save_reward_model

_WEIGHTS, _CARD = ".safetensors", ".json"


def store_reward_model(
    blobs: BlobStore, experiment_id: str, model: RewardModel, metrics: Mapping[str, float], segment_steps: int
) -> str:
    """Write a model. Returns the key of its weights, for the row that comes after.

    Raises:
        BlobsNotWritable: if the blobs are read-only or full.
    """
    saved = save_reward_model(model, metrics, segment_steps=segment_steps)
    stem = f"rewards/{experiment_id}/{new_id('rwb')}"
    blobs.put(stem + _CARD, saved.card)
    blobs.put(stem + _WEIGHTS, saved.weights)
    return stem + _WEIGHTS


def read_reward_model(blobs: BlobStore, weights_key: str) -> RewardModel:
    """The model whose row names this key.

    Raises:
        BlobMissing: if a blob of it is gone.
        mapt.rewards.errors.CheckpointError: if it is damaged, or newer than this program.
    """
    card_key = weights_key.removesuffix(_WEIGHTS) + _CARD
    return load_reward_model(blobs.read(weights_key), blobs.read(card_key)).model
