"""From raw observations and actions to the normalised inputs of the network."""

import torch
from torch import Tensor, nn

# Beyond this many standard deviations an input says "far out" and no more: one wild state must not
# buy an unbounded reward.
CLIP_DEVIATIONS = 10.0
# A number that varies less than this in all training segments is taken as constant.
SMALLEST_DEVIATION = 1e-6


class InputNormaliser(nn.Module):
    """Shifts and scales each number by the mean and deviation over the training segments.

    The statistics are pooled over agents, so that the same rule holds for each of them.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("deviation", torch.ones(dim))

    @torch.no_grad()
    def measure(self, values: Tensor, mask: Tensor) -> None:
        """Take the statistics of `values` (S, T, N, X) over the steps that `mask` (S, T) calls real."""
        real = values[mask].reshape(-1, values.shape[-1]).double()
        deviation = real.std(dim=0, correction=0)
        self.mean.copy_(real.mean(dim=0))
        self.deviation.copy_(torch.where(deviation < SMALLEST_DEVIATION, 1.0, deviation))

    def forward(self, values: Tensor) -> Tensor:
        """Normalise `values` (..., X)."""
        return ((values - self.mean) / self.deviation).clamp(-CLIP_DEVIATIONS, CLIP_DEVIATIONS)
