"""Actors that share their weights, and actors that have their own."""

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from mapt.policies import PolicyConfig
from mapt.policies.learner import make_policy
from mapt.policies.networks import ActorCritic, AgentLinear
from mapt.tasks import task_spec

pytestmark = pytest.mark.numerics

SPEC = task_spec("HalfCheetah-2x3")


def policy(shared: bool) -> ActorCritic:
    torch.manual_seed(0)
    net = make_policy(SPEC, PolicyConfig(shared_actor=shared, hidden=(16,)))
    assert isinstance(net, ActorCritic)
    # The last layer starts near zero, which would hide what the actions depend on.
    with torch.no_grad():
        for parameter in net.actor.network.parameters():
            parameter.normal_()
    return net


def observations(n: int = 5) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(n, SPEC.n_agents, SPEC.observation_dim)).astype(np.float32)


def test_batched_layers_equal_a_loop_over_agents() -> None:
    torch.manual_seed(0)
    layer = AgentLinear(3, 4, 2)
    torch.nn.init.normal_(layer.weight)
    torch.nn.init.normal_(layer.bias)
    inputs = torch.randn(3, 5, 4)
    loop = torch.stack([inputs[agent] @ layer.weight[agent] + layer.bias[agent] for agent in range(3)])
    torch.testing.assert_close(layer(inputs), loop)


@pytest.mark.parametrize("shared", [True, False])
def test_actions_depend_on_the_agents_own_observation_only(shared: bool) -> None:
    net, inputs = policy(shared), observations()
    before = net.act(inputs)
    inputs[:, 1] += 1.0
    after = net.act(inputs)
    np.testing.assert_array_equal(before[:, 0], after[:, 0])
    assert not np.array_equal(before[:, 1], after[:, 1])


@pytest.mark.parametrize("shared", [True, False])
def test_agents_with_equal_observations_act_alike_only_if_they_share_weights(shared: bool) -> None:
    inputs = np.repeat(observations()[:, :1], SPEC.n_agents, axis=1)
    actions = policy(shared).act(inputs)
    assert np.allclose(actions[:, 0], actions[:, 1]) == shared


@pytest.mark.parametrize("shared", [True, False])
def test_actor_has_the_density_and_entropy_of_a_normal_distribution(shared: bool) -> None:
    actor = policy(shared).actor
    assert actor.log_std is not None
    with torch.no_grad():
        actor.log_std.uniform_(-1, 1)
    inputs = torch.from_numpy(observations()).transpose(0, 1)
    actions = torch.randn(SPEC.n_agents, 5, SPEC.action_dim)
    normal = Normal(actor.network(inputs), actor.log_std.exp().expand_as(actions))
    torch.testing.assert_close(actor(inputs).log_prob(actions), normal.log_prob(actions).sum(-1))
    torch.testing.assert_close(actor(inputs).entropy(), normal.entropy().sum(-1).mean())


def test_training_one_agents_actor_changes_only_its_weights() -> None:
    actor = policy(shared=False).actor
    inputs = torch.from_numpy(observations()).transpose(0, 1)
    before = actor.network(inputs).detach()
    own = actor.of_agent(1)
    torch.testing.assert_close(own.network(inputs[1:2]), before[1:2])
    torch.optim.SGD(own.parameters(), lr=0.1).zero_grad()
    own.network(inputs[1:2]).square().sum().backward()
    torch.optim.SGD(own.parameters(), lr=0.1).step()
    after = actor.network(inputs).detach()
    assert torch.equal(after[0], before[0])
    assert not torch.allclose(after[1], before[1])
    torch.testing.assert_close(own.network(inputs[1:2]), after[1:2])


def test_actions_are_clipped_to_the_limit() -> None:
    net = policy(shared=True)
    noise = torch.full((SPEC.n_agents, 5, SPEC.action_dim), 50.0)
    assert np.abs(net.act(observations(), noise)).max() == SPEC.action_limit
