"""Running statistics that keep the networks' inputs and targets near zero mean and unit spread."""

import torch
from torch import Tensor, nn

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
