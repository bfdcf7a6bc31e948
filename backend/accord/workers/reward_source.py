"""Where the policy's rewards come from: the task itself, or the newest reward version."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from accord.services.experiment_config import ExperimentConfig
from accord.store.blobs import BlobStore
from accord.store.tables import RewardVersionRow
from accord.workers.model_store import read_reward_model
from mapt.policies import Rollout
from mapt.training.reward_source import Context, VersionedReward


class RewardSource(Protocol):
    """Rewards of whole rollouts, each rollout by one version."""

    @property
    def version_id(self) -> str | None:
        """The version in force; None for the true reward, and before the first."""
        ...

    def adopt(self, version: RewardVersionRow) -> bool:
        """Use this version from the next rollout on. Returns whether it is another than before."""
        ...

    def rewards(self, rollout: Rollout) -> NDArray[np.floating]:
        """(L, E), or (L, E, N) where each agent gets its own."""
        ...

    def context(self) -> Context:
        """What the next rewards look back on."""
        ...


class TrueReward:
    """The task's own reward: the baseline."""

    version_id = None

    def adopt(self, version: RewardVersionRow) -> bool:
        return False

    def rewards(self, rollout: Rollout) -> NDArray[np.floating]:
        return rollout.rewards

    def context(self) -> Context:
        return {}


class LearnedReward:
    """The newest reward version. Versions are immutable and change between rollouts alone."""

    def __init__(
        self, blobs: BlobStore, config: ExperimentConfig, n_envs: int, version_id: str | None, context: Context
    ) -> None:
        """
        Args:
            version_id, context: as of the checkpoint that training goes on from.
        """
        self._blobs = blobs
        self._reward = VersionedReward(
            config.segment_steps,
            n_envs,
            credit=config.credit,
            kind=config.policy_reward,
            device=config.device,
            version=version_id,
            context=context,
        )

    @property
    def version_id(self) -> str | None:
        return self._reward.version

    def adopt(self, version: RewardVersionRow) -> bool:
        """See `RewardSource.adopt`; the steps that rewards look back on are kept."""
        if self._reward.holds(version.id):
            return False
        return self._reward.adopt(read_reward_model(self._blobs, version.blob_key), version.id)

    def rewards(self, rollout: Rollout) -> NDArray[np.floating]:
        """See `RewardSource.rewards`. Call `adopt` before."""
        return self._reward.rewards(rollout)

    def context(self) -> Context:
        return self._reward.context()


def make_reward_source(
    blobs: BlobStore, config: ExperimentConfig, n_envs: int, version_id: str | None, context: Context
) -> RewardSource:
    """The source that the experiment's settings name."""
    if config.reward_source == "true":
        return TrueReward()
    return LearnedReward(blobs, config, n_envs, version_id, context)
