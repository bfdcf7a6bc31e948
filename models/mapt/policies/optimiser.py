"""Adam for networks that are so small that bookkeeping would cost as much as their gradients."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

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
