"""Keeps a critic's values right when the reward it predicts is replaced by another."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapt.policies.config import PolicyConfig
from mapt.policies.normalisation import ReturnStatistics


class RewardUnits:
    """Remembers the mean and spread of the last update's rewards, and moves values by them when the reward changes.

    A learned reward is defined up to scale and offset, and both move between versions. The critic's units are moved by
    the affine map that takes the old rewards' mean and spread to the new ones'. If the new version is but a rescaling,
    its values are right at once; if it is more, they start on the right scale.

    Args:
        config: whose gamma counts.
        horizon_steps: of the task.
    """

    def __init__(self, config: PolicyConfig, horizon_steps: int) -> None:
        # What an offset of 1 in every reward adds to a value: an endless sum, since truncation is bootstrapped.
        self._discounted_steps = float(horizon_steps) if config.gamma == 1.0 else 1.0 / (1.0 - config.gamma)
        self._moments: tuple[float, float] | None = None
        self._is_new = False

    def changed(self) -> None:
        """The next rewards come from another function than the last ones."""
        self._is_new = True

    def follow(self, rewards: NDArray[np.float32], statistics: ReturnStatistics) -> dict[str, float]:
        """Move the critic's units if the reward is a new one, remember this one's moments, and tell them."""
        mean, std = float(rewards.mean()), float(rewards.std())
        if self._is_new and self._moments is not None:
            old_mean, old_std = self._moments
            factor = std / old_std if old_std > 0 and std > 0 else 1.0
            statistics.transform(factor, (mean - factor * old_mean) * self._discounted_steps)
        self._is_new = False
        self._moments = mean, std
        return {"reward_mean": mean, "reward_std": std}

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that `load_state_dict` needs to go on exactly."""
        return {
            "reward_moments": torch.tensor(self._moments or (), dtype=torch.float64),
            "reward_is_new": torch.tensor(self._is_new),
        }

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Take up what another remembered."""
        moments = tensors["reward_moments"].tolist()
        self._moments = (moments[0], moments[1]) if moments else None
        self._is_new = bool(tensors["reward_is_new"])
