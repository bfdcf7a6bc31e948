"""Log-probabilities of Gaussian actions around the outputs of perceptrons, with the gradient written out.

A gradient step of such small networks spends more time on autograd's bookkeeping, some fifteen nodes, than on their
products. As one node it is, to the bit, what `Gaussian.log_probs` and the layers one by one give.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mapt.policies.actions import HALF_LOG_TWO_PI


class GaussianPerceptron(torch.autograd.Function):
    """Of `AgentLinear` layers with tanh between them, for N agents; see `forward`."""

    @staticmethod
    def forward(
        ctx: Any, inputs: Tensor, actions: Tensor, used: Tensor | None, log_std: Tensor, *layers: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Log-densities (N, B) of the actions, and the outputs (N, B, A), which carry no gradient.

        Args:
            inputs: (N, B, C), without gradient.
            actions: (N, B, A), without gradient.
            used: of `used_numbers`.
            log_std: (N, 1, A).
            layers: weight (N, in, out) and bias (N, 1, out) of each layer in turn.
        """
        weights, biases = layers[::2], layers[1::2]
        hidden = [inputs]
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            hidden.append(torch.baddbmm(bias, hidden[-1], weight).tanh_())
        outputs = torch.baddbmm(biases[-1], hidden[-1], weights[-1])
        distance, precision = actions - outputs, torch.exp(-log_std)
        noise = distance * precision
        density = -0.5 * noise.square() - log_std - HALF_LOG_TWO_PI
        ctx.used = used
        ctx.save_for_backward(distance, precision, noise, *hidden, *weights[1:])
        ctx.mark_non_differentiable(outputs)
        return (density if used is None else density * used).sum(-1), outputs

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (the decorator's declaration)
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        distance, precision, noise, *rest = ctx.saved_tensors
        n_layers = (len(rest) + 1) // 2
        hidden, weights = rest[:n_layers], rest[n_layers:]
        by_density = gradients[0][..., None].expand_as(noise)
        if ctx.used is not None:
            by_density = by_density * ctx.used
        by_noise = by_density * noise
        by_log_std = (by_noise * distance).sum(1, keepdim=True) * precision + (-by_density).sum(1, keepdim=True)
        by_output = by_noise * precision
        by_layers: list[Tensor] = []
        for number in reversed(range(n_layers)):
            of_layer = torch.bmm(hidden[number].transpose(1, 2), by_output), by_output.sum(1, keepdim=True)
            by_layers = [*of_layer, *by_layers]
            if number:
                through = torch.bmm(by_output, weights[number - 1].transpose(1, 2))
                by_output = torch.ops.aten.tanh_backward(through, hidden[number])
        return None, None, None, by_log_std, *by_layers
