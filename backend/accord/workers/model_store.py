"""Reward models, their ensembles and policy checkpoints in the blob store."""

import logging
import secrets
from collections.abc import Mapping

from accord.domain.ids import new_id
from accord.store.blobs import BlobStore
from accord.store.tables import RewardVersionRow
from mapt.errors import DamagedCheckpoint
from mapt.rewards.checkpoints import load_reward_model, save_reward_model
from mapt.rewards.ensemble import RewardEnsemble, load_reward_ensemble, save_reward_ensemble
from mapt.rewards.model import RewardModel
from mapt.training.run_folder import PolicyCheckpoint

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
        CheckpointError: if it is damaged, or newer than this program.
    """
    card_key = weights_key.removesuffix(_WEIGHTS) + _CARD
    return load_reward_model(blobs.read(weights_key), blobs.read(card_key)).model


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
    """Raises BlobMissing, CheckpointError."""
    return PolicyCheckpoint.from_bytes(blobs.read(key))


log = logging.getLogger(__name__)

#: ensembles kept in memory, over all experiments
_KEPT = 4


class Ensembles:
    """What was trained once is read again after a restart, so that a new process chooses as its predecessor would.

    No row names an ensemble: its blob's key follows from its version's. It is written once and whole; a process killed
    before that leaves nothing, and its successor trains the ensemble again.
    """

    def __init__(self, blobs: BlobStore) -> None:
        self._blobs = blobs
        #: by version id, the one used longest ago first
        self._kept: dict[str, RewardEnsemble] = {}
        #: ids of versions whose ensemble is stored: asked with every poll
        self._stored: set[str] = set()

    def has(self, version: RewardVersionRow) -> bool:
        """Whether the version's ensemble is stored."""
        if version.id not in self._stored and self._blobs.exists(_key(version)):
            self._stored.add(version.id)
        return version.id in self._stored

    def of(self, version: RewardVersionRow) -> RewardEnsemble | None:
        """The version's ensemble; None if it is to be trained (again).

        Raises:
            NewerCheckpoint: if a later version of this program wrote it.
        """
        ensemble = self._kept.get(version.id) or self._read(version)
        if ensemble is not None:
            self._keep(version.id, ensemble)
        return ensemble

    def store(self, version: RewardVersionRow, ensemble: RewardEnsemble) -> None:
        """Write a version's ensemble. Where there is one already, that one stays.

        Raises:
            BlobsNotWritable: if the blobs are read-only or full.
        """
        self._blobs.put(_key(version), save_reward_ensemble(ensemble))
        self._kept.pop(version.id, None)

    def _read(self, version: RewardVersionRow) -> RewardEnsemble | None:
        if not self.has(version):
            return None
        key = _key(version)
        try:
            return load_reward_ensemble(self._blobs.read(key))
        except DamagedCheckpoint:
            # Nothing is lost that the labels do not bring back.
            log.exception("%s is removed, to be trained again", key)
            self._blobs.delete(key)
            self._stored.discard(version.id)
            return None

    def _keep(self, version_id: str, ensemble: RewardEnsemble) -> None:
        self._kept.pop(version_id, None)
        self._kept[version_id] = ensemble
        while len(self._kept) > _KEPT:
            del self._kept[next(iter(self._kept))]


def _key(version: RewardVersionRow) -> str:
    return version.blob_key.rpartition(".")[0] + ".ensemble.safetensors"
