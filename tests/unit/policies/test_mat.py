"""The transformer decides agent after agent, and knows at the update what it knew then."""

import dataclasses

import pytest
import torch

from mapt.policies import PolicyConfig
from mapt.policies.mat import MultiAgentTransformer, TeamEncoder
from mapt.policies.networks import Batch
from mapt.tasks import TaskSpec, task_spec

pytestmark = pytest.mark.numerics

CHEETAH = task_spec("HalfCheetah-6x1")
CHOICES = dataclasses.replace(CHEETAH, action_dim=5, agent_action_dims=(), discrete_actions=True)
B = 9


def policy(spec: TaskSpec, layers: int = 2, heads: int = 2) -> MultiAgentTransformer:
    """With weights large enough that every path shows."""
    torch.manual_seed(0)
    net = MultiAgentTransformer(spec, PolicyConfig(algorithm="mat", width=16, layers=layers, heads=heads))
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return net


def moments(spec: TaskSpec) -> tuple[torch.Tensor, torch.Tensor | None]:
    torch.manual_seed(1)
    available = None
    if spec.discrete_actions:
        available = torch.rand(spec.n_agents, B, spec.action_dim) < 0.5
        available[..., 1] = True
    return torch.randn(spec.n_agents, B, spec.observation_dim), available


def batch(observations: torch.Tensor, actions: torch.Tensor, available: torch.Tensor | None) -> Batch:
    rest = torch.zeros(actions.shape[:2])
    return Batch(observations, actions, rest, rest, torch.zeros(B, 1), rest.T, available)


def drawn(net: MultiAgentTransformer) -> tuple[Batch, torch.Tensor]:
    """Actions drawn one after the other, and their log-probabilities."""
    observations, available = moments(net.spec)
    noise = net.noise((), B, torch.Generator().manual_seed(2))
    with torch.inference_mode():
        actions, log_probs = net.draw(observations, noise, available)
    return batch(observations, actions.clone(), available), log_probs.clone()


@pytest.mark.parametrize("spec", [CHEETAH, CHOICES], ids=["continuous", "discrete"])
@pytest.mark.parametrize(("layers", "heads"), [(1, 1), (3, 4)])
def test_decoding_with_cached_keys_equals_one_pass_over_all_agents(spec: TaskSpec, layers: int, heads: int) -> None:
    net = policy(spec, layers, heads)
    one_by_one, log_probs = drawn(net)
    torch.testing.assert_close(net.evaluate(one_by_one).log_probs, log_probs, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("spec", [CHEETAH, CHOICES], ids=["continuous", "discrete"])
def test_an_agent_knows_the_actions_before_its_own_and_no_others(spec: TaskSpec) -> None:
    net = policy(spec)
    before, _ = drawn(net)
    changed = before.actions.clone()
    changed[3] = changed[3].roll(1, -1) if spec.discrete_actions else changed[3] + 1.0
    free = dataclasses.replace(before, available=None)
    was = net.evaluate(free).log_probs
    now = net.evaluate(dataclasses.replace(free, actions=changed)).log_probs
    assert torch.equal(was[:3], now[:3])
    assert not torch.isclose(was[4:], now[4:], atol=1e-4).all(dim=1).any()


def test_what_every_agent_sees_counts_for_each() -> None:
    net = policy(CHEETAH)
    before, _ = drawn(net)
    seen = before.observations.clone()
    seen[5] += 1.0
    was, now = net.evaluate(before), net.evaluate(dataclasses.replace(before, observations=seen))
    assert not torch.isclose(was.log_probs, now.log_probs, atol=1e-4).all(dim=1).any()
    assert not torch.isclose(was.values, now.values, atol=1e-4).all(dim=0).any()


def test_permuted_agents_have_permuted_values() -> None:
    torch.manual_seed(0)
    encoder = TeamEncoder(4, PolicyConfig(width=16, layers=2, heads=2))
    seen, order = torch.randn(B, 6, 4), torch.randperm(6)
    torch.testing.assert_close(encoder(seen[:, order]), encoder(seen)[:, order], atol=1e-5, rtol=1e-5)


def test_unavailable_actions_are_never_chosen_even_if_preferred() -> None:
    net = policy(CHOICES)
    with torch.no_grad():
        net.decoder.network.head[-1].get_parameter("bias")[4] = 100.0
    moment, _ = drawn(net)
    assert moment.available is not None
    assert not (moment.actions.bool() & ~moment.available).any()
    assert (moment.actions[..., 4].bool() == moment.available[..., 4]).all()
