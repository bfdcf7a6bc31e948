"""Gradients that are written out, against autograd's of the plain formulas, to the bit."""

import dataclasses

import pytest
import torch
from torch import Tensor

from mapt.policies import PolicyConfig
from mapt.policies.distributions import Gaussian
from mapt.policies.networks import Actors
from mapt.policies.ppo import clipped_loss
from mapt.tasks import task_spec

pytestmark = pytest.mark.numerics

SPEC = task_spec("HalfCheetah-2x3")
B = 96


def plain_loss(log_ratio: Tensor, advantages: Tensor, clip: float) -> Tensor:
    ratio = log_ratio.exp()
    return -torch.minimum(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages).mean()


def samples(*shape: int, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("shape", [(256,), (6, 250), (1, 1)])
@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_the_clipped_loss_and_its_gradient(shape: tuple[int, ...], factor: float) -> None:
    """With ratios within the clip, beyond it on either side, and of one, for gains, losses and nothing."""
    log_ratio, advantages = 0.2 * samples(*shape, seed=0), samples(*shape, seed=1)
    log_ratio.view(-1)[::7], advantages.view(-1)[::11] = 0.0, 0.0
    ours, theirs = (log_ratio.clone().requires_grad_() for _ in range(2))
    loss, expected = clipped_loss(ours, advantages, 0.1), plain_loss(theirs, advantages, 0.1)
    assert torch.equal(loss, expected)
    (factor * loss).backward()
    (factor * expected).backward()
    assert ours.grad is not None
    assert theirs.grad is not None
    # A factor is multiplied last here and first there.
    torch.testing.assert_close(ours.grad, theirs.grad, atol=0, rtol=0 if factor == 1.0 else 1e-6)
    assert torch.equal(ours.grad == 0, theirs.grad == 0)
    if len(log_ratio.view(-1)) > 1:
        assert 0 < (ours.grad == 0).float().mean() < 1


@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_a_ratio_that_is_no_number_is_not_hidden(broken: float) -> None:
    log_ratio = torch.tensor([0.0, broken]).requires_grad_()
    clipped_loss(log_ratio, torch.ones(2), 0.1).backward()
    assert log_ratio.grad is not None
    assert not torch.isfinite(log_ratio.grad).all()


def actors(hidden: tuple[int, ...], used: tuple[int, ...]) -> Actors:
    torch.manual_seed(0)
    spec = dataclasses.replace(SPEC, agent_action_dims=used)
    made = Actors(spec, PolicyConfig(hidden=hidden))
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return made


@pytest.mark.parametrize("hidden", [(8,), (16, 8), (8, 16, 8)])
@pytest.mark.parametrize("used", [(3, 3), (3, 2)])
@pytest.mark.parametrize("entropy_weight", [0.0, 0.3])
def test_log_probabilities_of_perceptrons_and_their_gradients(
    hidden: tuple[int, ...], used: tuple[int, ...], entropy_weight: float
) -> None:
    actor = actors(hidden, used)
    inputs, actions = samples(2, B, SPEC.observation_dim, seed=2), samples(2, B, 3, seed=3)
    weights = samples(2, B, seed=4)

    log_probs, distribution = actor.evaluate(inputs, actions)
    plain = actor(inputs)
    expected = plain.log_probs(actions)
    assert isinstance(distribution, Gaussian)
    assert torch.equal(log_probs, expected)
    assert torch.equal(distribution.mean, plain.mean)

    def gradients(log_probs: Tensor, entropy: Tensor) -> tuple[Tensor, ...]:
        loss = (weights * log_probs).sum() - entropy_weight * entropy
        return torch.autograd.grad(loss, list(actor.parameters()))

    ours = gradients(log_probs, distribution.entropy())
    for (name, _), own, other in zip(actor.named_parameters(), ours, gradients(expected, plain.entropy()), strict=True):
        # Entropy's part of three is added last here and in between there.
        torch.testing.assert_close(own, other, atol=0, rtol=1e-5 if entropy_weight else 0, msg=name)
        assert own.abs().max() > 0, name
