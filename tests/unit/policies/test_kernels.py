"""Kernels against the torch functions that they replace."""

import pytest
import torch
from torch import Tensor, nn

from mapt.policies.kernels import Adam, clip_grad_norm_

pytestmark = pytest.mark.numerics

LEARNING_RATE = 0.01
EPSILON = 1e-5


def network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(7, 37), nn.Tanh(), nn.LayerNorm(37), nn.Linear(37, 3))


def adam(net: nn.Module) -> Adam:
    return Adam(net.parameters(), LEARNING_RATE, EPSILON)


def loss(net: nn.Module, seed: int) -> Tensor:
    inputs = torch.randn(20, 7, generator=torch.Generator().manual_seed(seed))
    return (0.01 + seed % 3) * net(inputs).square().mean()


def step(optimiser: Adam, net: nn.Module, seed: int) -> None:
    optimiser.zero_grad()
    loss(net, seed).backward()
    optimiser.step()


def test_adam_equals_torchs_adam() -> None:
    ours, theirs = network(), network()
    optimiser = adam(ours)
    reference = torch.optim.Adam(theirs.parameters(), lr=LEARNING_RATE, eps=EPSILON, fused=True)
    for seed in range(12):
        optimiser.learning_rate = reference.param_groups[0]["lr"] = LEARNING_RATE / (1 + seed)
        step(optimiser, ours, seed)
        reference.zero_grad()
        loss(theirs, seed).backward()
        reference.step()
        for own, other in zip(ours.parameters(), theirs.parameters(), strict=True):
            torch.testing.assert_close(own, other)
    states = reference.state_dict()["state"]
    expected = {f"{number}.{name}": tensor for number, state in states.items() for name, tensor in state.items()}
    assert optimiser.state_dict().keys() == expected.keys()
    for name, tensor in optimiser.state_dict().items():
        torch.testing.assert_close(tensor, expected[name])


@pytest.mark.parametrize("max_norm", [1e-2, 0.5, 100.0])
def test_clip_grad_norm_equals_torchs(max_norm: float) -> None:
    ours, theirs = network(), network()
    for net in (ours, theirs):
        loss(net, 2).backward()
    norm = clip_grad_norm_(list(ours.parameters()), max_norm)
    torch.testing.assert_close(norm, nn.utils.clip_grad_norm_(theirs.parameters(), max_norm))
    for own, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(own.grad, other.grad)


def test_adam_resumes_exactly_from_its_state() -> None:
    original, resumed = network(), network()
    optimiser = adam(original)
    for seed in range(3):
        step(optimiser, original, seed)
    resumed.load_state_dict(original.state_dict())
    other = adam(resumed)
    other.load_state_dict({name: tensor.clone() for name, tensor in optimiser.state_dict(first=6).items()}, first=6)
    step(optimiser, original, 9)
    step(other, resumed, 9)
    assert all(torch.equal(own, other) for own, other in zip(original.parameters(), resumed.parameters(), strict=True))


def test_adam_refuses_the_state_of_other_parameters() -> None:
    optimiser = adam(network())
    with pytest.raises(KeyError):
        optimiser.load_state_dict({"0.step": torch.zeros(())})
    with pytest.raises(RuntimeError):
        optimiser.load_state_dict({name: torch.zeros(2, 2) for name in optimiser.state_dict()})
