"""Rewards of a reward model that newer versions replace while a policy learns from it."""

import numpy as np
from numpy.typing import NDArray

from mapt.policies import Rollout
from mapt.rewards.base import PolicyReward, RewardModel
from mapt.rewards.relabelling import Credit, RolloutRelabeller

Context = dict[str, NDArray[np.generic]]


class VersionedReward:
    """Relabels whole rollouts, each by one version; versions change between rollouts alone.

    Args:
        segment_steps: T.
        n_envs: E.
        credit, kind, device: as in `RolloutRelabeller`.
        version, context: as of the checkpoint that training goes on from.
    """

    def __init__(
        self,
        segment_steps: int,
        n_envs: int,
        *,
        credit: Credit,
        kind: PolicyReward,
        device: str,
        version: str | None = None,
        context: Context | None = None,
    ) -> None:
        self._segment_steps, self._n_envs, self._device = segment_steps, n_envs, device
        self._credit: Credit = credit
        self._kind: PolicyReward = kind
        self._restored: Context = context or {}
        self._relabeller: RolloutRelabeller | None = None
        #: of the model in force; None before the first
        self.version = version

    def holds(self, version: str) -> bool:
        """Whether the model in force is of this version; one that was restored by name has to be adopted again."""
        return self._relabeller is not None and version == self.version

    def adopt(self, model: RewardModel, version: str) -> bool:
        """Use this model from the next rollout on; the steps that rewards look back on are kept.

        Returns:
            Whether it is another version than before: tell the learner, by `Learner.reward_changed`.

        Raises:
            ModelMismatch: if it is for a task of other dimensions than the last one.
        """
        if self._relabeller is None:
            self._relabeller = RolloutRelabeller(
                model, self._segment_steps, self._n_envs, self._credit, self._device, kind=self._kind
            )
            if self._restored:
                self._relabeller.load_state_dict(self._restored)
        else:
            self._relabeller.replace_model(model)
        changed = version != self.version
        self.version = version
        return changed

    def rewards(self, rollout: Rollout) -> NDArray[np.floating]:
        """(L, E), or (L, E, N) where each agent gets its own. Call `adopt` before."""
        if self._relabeller is None:
            raise RuntimeError("There is no reward version yet.")
        return self._relabeller.relabel(rollout.observations, rollout.actions, rollout.episode_start)

    def context(self) -> Context:
        """What the next rewards look back on."""
        return self._relabeller.state_dict() if self._relabeller else self._restored
