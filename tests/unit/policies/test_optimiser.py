"""Our Adam against torch's, to the bit."""

import pytest
import torch
from torch import Tensor, nn

from mapt.policies.kernels import EPSILON, Adam

RATE = 0.01


def network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(7, 37), nn.Tanh(), nn.LayerNorm(37), nn.Linear(37, 3))


def loss_of(net: nn.Module, number: int) -> Tensor:
    """Of random inputs; its gradient is at times above the largest norm and at times below."""
    inputs = torch.randn(20, 7, generator=torch.Generator().manual_seed(number))
    return (0.01 + number % 3) * net(inputs).square().mean()


@pytest.mark.parametrize("max_norm", [1e-2, 0.5, 100.0])
def test_every_step_is_torchs_to_the_bit(max_norm: float) -> None:
    ours, theirs = network(), network()
    adam = Adam([list(ours.parameters())], RATE, max_norm)
    reference = torch.optim.Adam(theirs.parameters(), lr=RATE, eps=EPSILON, fused=True)
    for number in range(12):
        adam.learning_rate = reference.param_groups[0]["lr"] = RATE / (1 + number)
        gradients, norm = adam.gradients(loss_of(ours, number))
        adam.step(gradients)
        reference.zero_grad()
        loss_of(theirs, number).backward()
        assert torch.equal(norm, nn.utils.clip_grad_norm_(theirs.parameters(), max_norm))
        reference.step()
        for own, other in zip(ours.parameters(), theirs.parameters(), strict=True):
            assert torch.equal(own, other)
    states = reference.state_dict()["state"]
    expected = {f"{number}.{name}": tensor for number, state in states.items() for name, tensor in state.items()}
    assert adam.state_dict().keys() == expected.keys()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in adam.state_dict().items())


def test_a_group_moves_alone_and_counts_its_own_steps() -> None:
    first, second = network(), network()
    adam = Adam([list(first.parameters()), list(second.parameters())], RATE, 0.5)
    for number in range(3):
        adam.step(adam.gradients(loss_of(second, number), 1)[0], 1)
    start = network()
    assert all(torch.equal(own, other) for own, other in zip(first.parameters(), start.parameters(), strict=True))
    assert not torch.equal(next(second.parameters()), next(start.parameters()))
    assert [int(adam.state_dict()[f"{number}.step"]) for number in (0, 6)] == [0, 3]


def test_an_optimiser_goes_on_from_anothers_state() -> None:
    whole, resumed = network(), network()
    adam = Adam([list(whole.parameters())], RATE, 0.5)
    for number in range(3):
        adam.step(adam.gradients(loss_of(whole, number))[0])
    resumed.load_state_dict(whole.state_dict())
    other = Adam([list(resumed.parameters())], RATE, 0.5)
    other.load_state_dict({name: tensor.clone() for name, tensor in adam.state_dict().items()})
    for net, optimiser in ((whole, adam), (resumed, other)):
        optimiser.step(optimiser.gradients(loss_of(net, 9))[0])
    assert all(torch.equal(own, other) for own, other in zip(whole.parameters(), resumed.parameters(), strict=True))


def test_a_state_of_other_parameters_is_refused() -> None:
    adam = Adam([list(network().parameters())], RATE, 0.5)
    with pytest.raises(KeyError):
        adam.load_state_dict({"0.step": torch.zeros(())})
    with pytest.raises(RuntimeError):
        adam.load_state_dict({name: torch.zeros(2, 2) for name in adam.state_dict()})
