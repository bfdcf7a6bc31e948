"""Draws and their probabilities, against torch's own distributions and by counting."""

import dataclasses

import pytest
import torch
from torch.distributions import Categorical as TorchCategorical
from torch.distributions import Normal

from mapt.policies import PolicyConfig
from mapt.policies.distributions import Categorical, Gaussian, action_noise
from mapt.policies.learner import make_policy
from mapt.tasks import task_spec

pytestmark = pytest.mark.numerics

SPEC = dataclasses.replace(task_spec("HalfCheetah-6x1"), discrete_actions=True, action_dim=5, agent_action_dims=())


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def logits_and_mask(n: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    available = torch.rand(n, 5, generator=generator()) < 0.4
    available[:, 2] = True
    # What is not available would be by far the likeliest.
    logits = torch.randn(n, 5, generator=generator()) + torch.where(available, 0.0, 50.0)
    return logits, available


def test_draws_are_as_frequent_as_their_probabilities_and_never_unavailable() -> None:
    logits, available = logits_and_mask(8)
    distribution = Categorical.masked(logits.expand(20_000, 8, 5), available)
    actions, log_probs = distribution.draw(action_noise(SPEC, (20_000, 8), generator()))
    assert (actions.sum(-1) == 1).all()
    assert not (actions.bool() & ~available).any()
    expected = logits.masked_fill(~available, -torch.inf).softmax(-1)
    torch.testing.assert_close(actions.mean(0), expected, atol=0.015, rtol=0)
    torch.testing.assert_close(log_probs, distribution.log_probs(actions))


def test_probabilities_and_entropy_are_those_of_the_available_choices() -> None:
    logits, available = logits_and_mask()
    ours = Categorical.masked(logits.requires_grad_(), available)
    reference = TorchCategorical(logits=logits.detach().masked_fill(~available, -1e30))
    actions, log_probs = ours.draw(None)
    assert not (actions.bool() & ~available).any()
    torch.testing.assert_close(log_probs, reference.log_prob(actions.argmax(-1)))
    torch.testing.assert_close(ours.entropy(), reference.entropy().mean())
    (gradient,) = torch.autograd.grad(ours.entropy() + log_probs.sum(), logits)
    assert torch.isfinite(gradient).all()
    assert (gradient[~available] == 0).all()


def test_a_gaussian_draw_has_the_density_it_is_told() -> None:
    mean, log_std = torch.randn(6, 7, 2, generator=generator()), torch.randn(6, 1, 2, generator=generator())
    gaussian = Gaussian(mean, log_std)
    for noise in (torch.randn(6, 7, 2, generator=generator()), None):
        actions, log_probs = gaussian.draw(noise)
        torch.testing.assert_close(log_probs, gaussian.log_probs(actions), atol=1e-5, rtol=1e-5)
    assert torch.equal(gaussian.draw(None)[0], mean)


@pytest.mark.parametrize("algorithm", ["mappo", "mat"])
def test_numbers_that_an_agent_does_not_use_are_zero_and_count_for_nothing(algorithm: str) -> None:
    """Agent 1 uses one of two numbers."""
    spec = dataclasses.replace(task_spec("HalfCheetah-2x3"), action_dim=2, agent_action_dims=(2, 1))
    torch.manual_seed(0)
    policy = make_policy(spec, PolicyConfig.named(algorithm, width=8, initial_log_std=0.0))
    noise = torch.randn(2, 5, 2)
    with torch.no_grad():
        actions, log_probs = policy.draw(torch.randn(2, 5, spec.observation_dim), noise, None)
    assert (actions[1, :, 1] == 0).all()
    assert (actions[1, :, 0] != 0).all()
    density = Normal(0.0, 1.0).log_prob(noise)
    torch.testing.assert_close(log_probs, torch.stack([density[0].sum(-1), density[1, :, 0]]))
