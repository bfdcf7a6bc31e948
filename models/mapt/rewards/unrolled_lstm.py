"""An LSTM that `torch.vmap` can run."""

import torch
from torch import Tensor, nn


class UnrolledLSTM(nn.Module):
    """A batch-first `nn.LSTM` written out step by step, with its very parameters under their names.

    `nn.LSTM` is one call into a library that has no rule for a stack of members. Only what must be sequential is: the
    inputs of all steps are mapped in one product, and a step is one product for all members.
    """

    def __init__(self, lstm: nn.LSTM) -> None:
        super().__init__()
        self.layers = lstm.num_layers
        for name, parameter in lstm.named_parameters():
            self.register_parameter(name, parameter)

    def forward(self, x: Tensor) -> tuple[Tensor, None]:
        """x (B, T, D) -> what the last layer puts out, (B, T, d), and no state."""
        for layer in range(self.layers):
            x = self._layer(x, f"l{layer}")
        return x, None

    def _layer(self, x: Tensor, layer: str) -> Tensor:
        recurrent = getattr(self, f"weight_hh_{layer}").T
        bias = getattr(self, f"bias_ih_{layer}") + getattr(self, f"bias_hh_{layer}")
        inputs = (x @ getattr(self, f"weight_ih_{layer}").T + bias).unbind(dim=1)
        hidden = cell = torch.zeros_like(inputs[0].chunk(4, dim=-1)[0])
        outputs = []
        for given in inputs:
            entry, forget, candidate, exit_ = (given + hidden @ recurrent).chunk(4, dim=-1)
            cell = forget.sigmoid() * cell + entry.sigmoid() * candidate.tanh()
            hidden = exit_.sigmoid() * cell.tanh()
            outputs.append(hidden)
        return torch.stack(outputs, dim=1)


def unroll_lstms(module: nn.Module) -> None:
    """Put an `UnrolledLSTM` in the place of every `nn.LSTM` of `module`."""
    for name, child in list(module.named_children()):
        if isinstance(child, nn.LSTM):
            setattr(module, name, UnrolledLSTM(child))
        else:
            unroll_lstms(child)
