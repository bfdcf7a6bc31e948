"""The last layers, which end in one number: in float32 whatever is around them.

bfloat16 keeps three digits. A score is the difference of means over hundreds of rewards: its own digits are those.
"""

from contextlib import AbstractContextManager

import torch
from torch import Tensor, nn


def in_float32(x: Tensor) -> AbstractContextManager[object]:
    """Within it, products on the device of `x` are taken in the type of their factors."""
    return torch.autocast(x.device.type, enabled=False)


class ScalarLinear(nn.Linear):
    """A linear map of (..., D) to one number, (..., 1)."""

    def __init__(self, dim: int) -> None:
        super().__init__(dim, 1)

    def forward(self, input: Tensor) -> Tensor:
        with in_float32(input):
            return super().forward(input.float())
