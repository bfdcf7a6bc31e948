"""From raw observations and actions to the normalised inputs of the network."""

from collections.abc import Sequence

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
    def measure(self, values: Tensor, mask: Tensor, readers: Sequence[tuple[nn.Linear, int]]) -> None:
        """Take the statistics of `values` (S, T, N, X) over the steps that `mask` (S, T) calls real.

        Args:
            readers: layers that read the normalised numbers, each with the column where they begin there.
                Their weights are changed so that they give what they gave before.
        """
        real = values[mask].reshape(-1, values.shape[-1]).double()
        measured = real.std(dim=0, correction=0)
        deviation = torch.where(measured < SMALLEST_DEVIATION, 1.0, measured).float()
        mean = real.mean(dim=0).float()
        for layer, offset in readers:
            weight = layer.weight[:, offset : offset + len(mean)]
            layer.bias.add_(weight @ ((mean - self.mean) / self.deviation))
            weight.mul_(deviation / self.deviation)
        self.mean.copy_(mean)
        self.deviation.copy_(deviation)

    def forward(self, values: Tensor) -> Tensor:
        """Normalise `values` (..., X)."""
        return ((values - self.mean) / self.deviation).clamp(-CLIP_DEVIATIONS, CLIP_DEVIATIONS)
