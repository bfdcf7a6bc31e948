"""Layers that several networks are made of."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

_ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}


class AgentLinear(nn.Module):
    """A linear layer of its own for each of N agents: (N, B, in) -> (N, B, out) in one batched product."""

    def __init__(self, n_agents: int, n_in: int, n_out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(n_agents, n_in, n_out))
        self.bias = nn.Parameter(torch.zeros(n_agents, 1, n_out))

    def forward(self, inputs: Tensor) -> Tensor:
        return torch.baddbmm(self.bias, inputs, self.weight)


def perceptron(
    layer: Callable[[int, int], nn.Module], sizes: Sequence[int], activation: str, last_gain: float
) -> nn.Sequential:
    """Layers with orthogonal weights and zero biases, the last scaled by `last_gain`."""
    modules: list[nn.Module] = []
    for n_in, n_out in pairwise(sizes):
        modules += [layer(n_in, n_out), _ACTIVATIONS[activation]()]
    modules.pop()
    linears = modules[::2]
    for linear in linears:
        initialise(linear, last_gain if linear is linears[-1] else math.sqrt(2))
    return nn.Sequential(*modules)


def initialise(linear: nn.Module, gain: float) -> None:
    """Orthogonal weights, each agent's if there are several, and zero biases."""
    weight, bias = linear.get_parameter("weight"), linear.get_parameter("bias")
    for matrix in weight if weight.dim() == 3 else (weight,):
        nn.init.orthogonal_(matrix, gain)
    nn.init.zeros_(bias)
