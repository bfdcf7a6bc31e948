"""Running statistics that keep the networks' inputs and targets near zero mean and unit spread."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mapt.policies.config import PolicyConfig

#: Normalised inputs are cut to plus and minus this many standard deviations.
INPUT_LIMIT = 10.0
#: Below this standard deviation a number counts as constant.
CONSTANT_BELOW = 1e-4


class InputNormaliser(nn.Module):
    """Mean and spread of each input over everything seen so far.

    Inputs that never change, such as an agent's one-hot index under statistics of its own, pass as they are.
    Statistics change only in `absorb`, so a rollout and its update see the same network.

    Args:
        shape: of the statistics, broadcast against inputs whose dimension `over` is summed out.
        over: dimension of the samples.
    """

    mean: Tensor
    squares: Tensor
    count: Tensor
    shift: Tensor
    scale: Tensor

    def __init__(self, *shape: int, over: int) -> None:
        super().__init__()
        self._over = over
        # Sums over millions of steps need float64; what is applied is float32.
        self.register_buffer("mean", torch.zeros(shape, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(shape, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(shape))
        self.register_buffer("scale", torch.ones(shape))

    def forward(self, inputs: Tensor) -> Tensor:
        return ((inputs - self.shift) * self.scale).clamp_(-INPUT_LIMIT, INPUT_LIMIT)

    @torch.no_grad()
    def absorb(self, inputs: Tensor) -> None:
        """Add a batch to the statistics (Chan, Golub and LeVeque's pairwise update)."""
        inputs = inputs.double()
        n = inputs.shape[self._over]
        mean = inputs.mean(self._over, keepdim=True)
        squares = (inputs - mean).square().sum(self._over, keepdim=True)
        gap, total = mean - self.mean, self.count + n
        self.squares += squares + gap.square() * (self.count * n / total)
        self.mean += gap * (n / total)
        self.count.copy_(total)

        std = (self.squares / self.count).sqrt()
        varies = std > CONSTANT_BELOW
        self.shift.copy_(torch.where(varies, self.mean, 0.0))
        self.scale.copy_(torch.where(varies, 1.0 / std, 1.0))


class ReturnStatistics(nn.Module):
    """Mean and spread of the returns of each of N agents, leaning towards the newest rollouts.

    The critic predicts returns in these units. Leaning, rather than averaging over all time, because a policy's returns
    grow as it learns and a learned reward may change its scale from version to version.

    Args:
        n_agents: N.
        rate: weight of the newest rollout.
    """

    mean: Tensor
    std: Tensor
    mean_sum: Tensor
    square_sum: Tensor
    weight: Tensor

    def __init__(self, n_agents: int, rate: float) -> None:
        super().__init__()
        self._rate = rate
        # The spread is a difference of these sums, which float32 would lose under a large mean.
        for name in ("mean_sum", "square_sum"):
            self.register_buffer(name, torch.zeros(n_agents, dtype=torch.float64))
        self.register_buffer("weight", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(n_agents))
        self.register_buffer("std", torch.ones(n_agents))

    def normalise(self, returns: Tensor) -> Tensor:
        return (returns - self.mean) / self.std

    def denormalise(self, predictions: Tensor) -> Tensor:
        return predictions * self.std + self.mean

    @torch.no_grad()
    def absorb(self, returns: Tensor) -> None:
        """Lean towards the returns (B, N) of a new rollout."""
        returns, keep = returns.double(), 1.0 - self._rate
        self.mean_sum.mul_(keep).add_(self._rate * returns.mean(0))
        self.square_sum.mul_(keep).add_(self._rate * returns.square().mean(0))
        self.weight.mul_(keep).add_(self._rate)
        mean = self.mean_sum / self.weight
        variance = self.square_sum / self.weight - mean.square()
        self.mean.copy_(mean)
        self.std.copy_(variance.clamp_min(CONSTANT_BELOW**2).sqrt())

    @torch.no_grad()
    def transform(self, factor: float, offset: float) -> None:
        """Move to returns that are `factor` times the old ones plus `offset`."""
        self.square_sum.copy_(
            factor**2 * self.square_sum + 2 * factor * offset * self.mean_sum + offset**2 * self.weight
        )
        self.mean_sum.copy_(factor * self.mean_sum + offset * self.weight)
        self.mean.copy_(factor * self.mean + offset)
        self.std.mul_(factor)


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
