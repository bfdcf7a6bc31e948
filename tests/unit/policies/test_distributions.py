"""Samples and their probabilities, against torch.distributions and by counting."""

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
    # Unavailable actions would be by far the most likely.
    logits = torch.randn(n, 5, generator=generator()) + torch.where(available, 0.0, 50.0)
    return logits, available


def test_samples_follow_the_probabilities_of_the_available_actions() -> None:
    logits, available = logits_and_mask(8)
    distribution = Categorical(logits.expand(20_000, 8, 5), available)
    actions = distribution.sample(action_noise(SPEC, (20_000, 8), generator()))
    assert (actions.sum(-1) == 1).all()
    assert not (actions.bool() & ~available).any()
    expected = logits.masked_fill(~available, -torch.inf).softmax(-1)
    torch.testing.assert_close(actions.mean(0), expected, atol=0.015, rtol=0)


def test_probabilities_and_entropy_of_a_categorical_ignore_unavailable_actions() -> None:
    logits, available = logits_and_mask()
    ours = Categorical(logits.requires_grad_(), available)
    reference = TorchCategorical(logits=logits.detach().masked_fill(~available, -1e30))
    actions = ours.sample(None)
    log_probs = ours.log_prob(actions)
    assert not (actions.bool() & ~available).any()
    torch.testing.assert_close(log_probs, reference.log_prob(actions.argmax(-1)))
    torch.testing.assert_close(ours.entropy(), reference.entropy().mean())
    (gradient,) = torch.autograd.grad(ours.entropy() + log_probs.sum(), logits)
    assert torch.isfinite(gradient).all()
    assert (gradient[~available] == 0).all()


def test_gaussian_has_the_density_and_entropy_of_torchs_normal_distribution() -> None:
    mean, log_std = torch.randn(6, 7, 2, generator=generator()), torch.randn(6, 1, 2, generator=generator())
    gaussian, normal = Gaussian(mean, log_std), Normal(mean, log_std.exp().expand_as(mean))
    noise = torch.randn(6, 7, 2, generator=generator())
    torch.testing.assert_close(gaussian.sample(noise), normal.mean + normal.stddev * noise)
    for actions in (gaussian.sample(noise), gaussian.sample(None)):
        torch.testing.assert_close(gaussian.log_prob(actions), normal.log_prob(actions).sum(-1), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(gaussian.entropy(), normal.entropy().sum(-1).mean())
    assert torch.equal(gaussian.sample(None), mean)


@pytest.mark.parametrize("algorithm", ["mappo", "mat"])
def test_unused_action_dimensions_are_zero_and_add_nothing_to_probabilities(algorithm: str) -> None:
    """Agent 1 uses one of two dimensions."""
    spec = dataclasses.replace(task_spec("HalfCheetah-2x3"), action_dim=2, agent_action_dims=(2, 1))
    torch.manual_seed(0)
    policy = make_policy(spec, PolicyConfig.named(algorithm, width=8, initial_log_std=0.0))
    noise = torch.randn(2, 5, 2)
    with torch.no_grad():
        actions, log_probs = policy.sample(torch.randn(2, 5, spec.observation_dim), noise, None)
    assert (actions[1, :, 1] == 0).all()
    assert (actions[1, :, 0] != 0).all()
    density = Normal(0.0, 1.0).log_prob(noise)
    torch.testing.assert_close(log_probs, torch.stack([density[0].sum(-1), density[1, :, 0]]))
