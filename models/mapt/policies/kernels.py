"""Log-probabilities of Gaussian actions around the outputs of perceptrons, with the gradient written out.

A gradient step of such small networks spends more time on autograd's bookkeeping, some fifteen nodes, than on their
products. As one node it is, to the bit, what `Gaussian.log_probs` and the layers one by one give.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mapt.policies.distributions import HALF_LOG_TWO_PI


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


BETAS = 0.9, 0.999
#: As PPO's reference code has it: gradients of normalised losses are small.
EPSILON = 1e-5


class Adam:
    """Adam (Kingma and Ba 2015) on gradients that are scaled down to a largest norm.

    Every number is, to the bit, that of `torch.nn.utils.clip_grad_norm_` and `torch.optim.Adam(fused=True)`. They spend
    many times as long on looking at a dozen small tensors as on computing; here it is known what the tensors are.

    Args:
        groups: parameters that are moved together; each group by losses of its own.
        learning_rate: of the first steps; may be set anew at any time.
        max_norm: largest norm of the gradient of a group.
    """

    def __init__(self, groups: Sequence[Sequence[nn.Parameter]], learning_rate: float, max_norm: float) -> None:
        self._groups = [_Group(parameters) for parameters in groups]
        self.learning_rate = learning_rate
        self._max_norm = max_norm

    def gradients(self, loss: Tensor, group: int = 0) -> tuple[list[Tensor], Tensor]:
        """Gradients of a loss, scaled down, and the norm () that they had before."""
        gradients = torch.autograd.grad(loss, self._groups[group].parameters)
        norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))  # pyright: ignore[reportPrivateImportUsage]
        scale = (self._max_norm / (norm + 1e-6)).clamp(max=1.0)
        return list(torch._foreach_mul(gradients, scale)), norm  # pyright: ignore[reportPrivateImportUsage]

    @torch.no_grad()
    def step(self, gradients: list[Tensor], group: int = 0) -> None:
        """Move a group by its `gradients`."""
        own = self._groups[group]
        own.count += 1
        torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
            own.parameters,
            gradients,
            own.means,
            own.squares,
            [],
            [own.count] * len(gradients),
            lr=self.learning_rate,
            beta1=BETAS[0],
            beta2=BETAS[1],
            weight_decay=0.0,
            eps=EPSILON,
            amsgrad=False,
            maximize=False,
        )

    def state_dict(self) -> dict[str, Tensor]:
        """The very tensors as "number of the parameter.name", named as torch's Adam does."""
        states = (
            {"step": group.count, "exp_avg": mean, "exp_avg_sq": square}
            for group in self._groups
            for mean, square in zip(group.means, group.squares, strict=True)
        )
        return {f"{number}.{name}": tensor for number, state in enumerate(states) for name, tensor in state.items()}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Copy what `state_dict` gave; nothing, if it is empty, as before the first step.

        Raises:
            KeyError: if a tensor is missing.
            RuntimeError: if one has another shape.
        """
        for name, tensor in self.state_dict().items():
            tensor.copy_(tensors[name]) if tensors else tensor.zero_()


class _Group:
    """Parameters and what Adam knows of their gradients."""

    def __init__(self, parameters: Sequence[nn.Parameter]) -> None:
        self.parameters: list[Tensor] = list(parameters)
        self.means = [torch.zeros_like(parameter, requires_grad=False) for parameter in parameters]
        self.squares = [torch.zeros_like(parameter, requires_grad=False) for parameter in parameters]
        #: Steps taken, a float32 on the parameters' device, as the kernel wants it.
        self.count = torch.zeros((), device=self.parameters[0].device)
