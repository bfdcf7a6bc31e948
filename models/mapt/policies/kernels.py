"""Faster replacements for parts of torch whose overhead exceeds a tenth of a whole run, each with its benchmark.

Private functions of torch are used here and nowhere else in this package.
"""

from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor, nn

BETAS = 0.9, 0.999


@torch.no_grad()
def clip_grad_norm_(parameters: Sequence[Tensor], max_norm: float) -> Tensor:
    """`torch.nn.utils.clip_grad_norm_`, for parameters of one device that all have a gradient.

    torch's function groups the gradients by device and type first. With it, a whole HAPPO run takes 3% longer; with it
    and `torch.optim.Adam`, 20%. Benchmark: tests/benchmarks/bench_kernels.py.

    Returns:
        The norm () of the gradients before.
    """
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))  # pyright: ignore[reportPrivateImportUsage]
    scale = (max_norm / (norm + 1e-6)).clamp(max=1.0)
    torch._foreach_mul_(gradients, scale)  # pyright: ignore[reportPrivateImportUsage]
    return norm


class Adam:
    """`torch.optim.Adam(parameters, learning_rate, eps=eps, fused=True)`, with equal results to the last bit.

    `torch.optim.Adam` inspects and groups its parameters in each step, which takes longer than the fused kernel does
    for a dozen small tensors. With it, a whole HAPPO run (rollout and update of HalfCheetah-6x1 on one CPU thread)
    takes 11% longer; MAPPO 3%, MAT 2%. Benchmark: tests/benchmarks/bench_kernels.py.

    Args:
        parameters: to optimise; every one has a gradient in every step.
        learning_rate: may be changed between steps.
        eps: added to the denominator.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], learning_rate: float, eps: float) -> None:
        self.parameters = list(parameters)
        self.learning_rate = learning_rate
        self._eps = eps
        self._exp_avg = [torch.zeros_like(parameter, requires_grad=False) for parameter in self.parameters]
        self._exp_avg_sq = [torch.zeros_like(parameter, requires_grad=False) for parameter in self.parameters]
        # The kernel requires float32 on the parameters' device.
        self._n_steps = torch.zeros((), device=self.parameters[0].device)

    def zero_grad(self) -> None:
        """Set all gradients to None."""
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update the parameters by their gradients."""
        self._n_steps += 1
        parameters: list[Tensor] = [*self.parameters]
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
            parameters,
            gradients,
            self._exp_avg,
            self._exp_avg_sq,
            [],
            [self._n_steps] * len(gradients),
            lr=self.learning_rate,
            beta1=BETAS[0],
            beta2=BETAS[1],
            weight_decay=0.0,
            eps=self._eps,
            amsgrad=False,
            maximize=False,
        )

    def state_dict(self, first: int = 0) -> dict[str, Tensor]:
        """The state tensors themselves, named as in torch: "0.step", "0.exp_avg", "0.exp_avg_sq", "1.step", ...

        Args:
            first: number of the first parameter.
        """
        return {
            f"{number}.{name}": tensor
            for number, (mean, square) in enumerate(zip(self._exp_avg, self._exp_avg_sq, strict=True), first)
            for name, tensor in (("step", self._n_steps), ("exp_avg", mean), ("exp_avg_sq", square))
        }

    def load_state_dict(self, tensors: Mapping[str, Tensor], first: int = 0) -> None:
        """Copy the tensors of `state_dict`; an empty mapping resets the state.

        Raises:
            KeyError: if a tensor is missing.
            RuntimeError: if a tensor has another shape.
        """
        for name, tensor in self.state_dict(first).items():
            tensor.copy_(tensors[name]) if tensors else tensor.zero_()
