"""Ensembles of reward versions, by which queries are chosen: in the blobs, and the latest ones in memory."""

import logging

from accord.store.blobs import BlobStore
from accord.store.tables import RewardVersionRow
from mapt.rewards.ensemble_storage import load_reward_ensemble, save_reward_ensemble
from mapt.rewards.errors import DamagedCheckpoint
from mapt.rewards.members import RewardEnsemble

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
            mapt.rewards.errors.NewerCheckpoint: if a later version of this program wrote it.
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
