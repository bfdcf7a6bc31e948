import pytest
import torch
from torch import nn

from mapt.rewards.unrolled_lstm import UnrolledLSTM, unroll_lstms


@pytest.mark.parametrize("layers", [1, 2])
def test_an_unrolled_lstm_gives_what_the_lstm_gives_and_learns_as_it(layers):
    torch.manual_seed(0)
    lstm = nn.LSTM(5, 8, num_layers=layers, batch_first=True)
    x = torch.randn(3, 6, 5)
    expected = lstm(x)[0]
    expected.square().sum().backward()
    gradients = {name: parameter.grad.clone() for name, parameter in lstm.named_parameters()}
    lstm.zero_grad()
    unrolled = UnrolledLSTM(lstm)
    found = unrolled(x)[0]
    torch.testing.assert_close(found, expected)
    found.square().sum().backward()
    assert dict(unrolled.named_parameters()).keys() == gradients.keys()
    for name, parameter in unrolled.named_parameters():
        torch.testing.assert_close(parameter.grad, gradients[name])


def test_unrolling_reaches_every_lstm_and_keeps_the_names_of_the_weights():
    model = nn.ModuleDict({"inner": nn.ModuleDict({"lstm": nn.LSTM(2, 3, batch_first=True)}), "out": nn.Linear(3, 1)})
    names = list(model.state_dict())
    unroll_lstms(model)
    assert list(model.state_dict()) == names
    assert not any(isinstance(module, nn.LSTM) for module in model.modules())
