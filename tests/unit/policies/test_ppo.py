"""PPO: advantages, the clipped surrogate loss, and the updates against straightforward implementations."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.distributions import Normal

from learning.identity_task import IdentityTask
from mapt.errors import TrainingDiverged
from mapt.policies import Learner, PolicyConfig
from mapt.policies.config import Algorithm
from mapt.policies.learner import make_update
from mapt.policies.networks import ActorCritic
from mapt.policies.ppo import ADAM_EPSILON, clip_gradients, clipped_surrogate_loss, gae, make_batch, team_rewards
from mapt.tasks import make_task

pytestmark = pytest.mark.numerics

#: A hundredth of what Adam moves a parameter at most in three steps of 0.02. Adam divides gradients by their size,
#: so that the rounding of a gradient near zero shows at this scale.
TOLERANCE = 0.01 * 3 * 0.02
SETTINGS = {"n_envs": 4, "rollout_steps": 6, "epochs": 3, "minibatches": 1, "hidden": [5], "device": "cpu"}


def slow_gae(rewards, values, next_values, terminated, truncated, gamma, gae_lambda) -> np.ndarray:
    """Sum of (gamma * lambda)^k times the TD error k steps later, to the end of the episode or rollout."""
    n_steps, n_envs, n_agents = rewards.shape
    advantages = np.zeros_like(rewards)
    for t in range(n_steps):
        for env in range(n_envs):
            for agent in range(n_agents):
                for k in range(t, n_steps):
                    future = 0.0 if terminated[k, env] else gamma * next_values[k, env, agent]
                    delta = rewards[k, env, agent] + future - values[k, env, agent]
                    advantages[t, env, agent] += (gamma * gae_lambda) ** (k - t) * delta
                    if terminated[k, env] or truncated[k, env]:
                        break
    return advantages


@given(
    seed=st.integers(0, 2**32 - 1),
    n_steps=st.integers(1, 9),
    gamma=st.floats(0, 1),
    gae_lambda=st.floats(0, 1),
    end_probability=st.floats(0, 0.6),
)
@settings(max_examples=60, deadline=None)
def test_gae_equals_the_slow_sum(seed, n_steps, gamma, gae_lambda, end_probability) -> None:
    rng = np.random.default_rng(seed)
    rewards, values, next_values = rng.normal(size=(3, n_steps, 3, 2))
    terminated = rng.random((n_steps, 3)) < end_probability
    truncated = (rng.random((n_steps, 3)) < end_probability) & ~terminated
    fast = gae(rewards, values, next_values, terminated, truncated, gamma=gamma, gae_lambda=gae_lambda)
    slow = slow_gae(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
    np.testing.assert_allclose(fast, slow, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("terminated", "expected"), [(True, 1.0), (False, 1.0 + 0.9 * 10.0)])
def test_gae_bootstraps_after_truncation_but_not_after_termination(terminated: bool, expected: float) -> None:
    one = np.ones((1, 1, 1))
    ended = np.array([[terminated]])
    result = gae(one, 0 * one, 10 * one, ended, ~ended, gamma=0.9, gae_lambda=0.5)
    assert result.item() == pytest.approx(expected)


def test_gae_excludes_the_rewards_of_the_next_episode() -> None:
    rewards, zeros = np.array([1.0, 100.0]).reshape(2, 1, 1), np.zeros((2, 1, 1))
    truncated = np.array([[True], [False]])
    result = gae(rewards, zeros, zeros, np.zeros_like(truncated), truncated, gamma=0.9, gae_lambda=0.9)
    np.testing.assert_allclose(result.ravel(), [1.0, 100.0])


@pytest.mark.parametrize(
    ("ratio", "advantage", "objective", "slope"),
    [(1.05, 2.0, 2.1, 2.0), (1.3, 2.0, 2.2, 0.0), (1.3, -2.0, -2.6, -2.0), (0.7, 2.0, 1.4, 2.0), (0.7, -2.0, -1.8, 0)],
)
def test_ratios_beyond_the_clip_have_no_gradient_where_they_improve_the_objective(
    ratio: float, advantage: float, objective: float, slope: float
) -> None:
    log_ratio = torch.tensor([math.log(ratio)], requires_grad=True)
    loss = clipped_surrogate_loss(log_ratio, torch.tensor([advantage]), clip=0.1)
    loss.backward()
    assert loss.item() == pytest.approx(-objective, rel=1e-5)
    assert log_ratio.grad is not None
    # d ratio / d log ratio is the ratio.
    assert log_ratio.grad.item() == pytest.approx(-slope * ratio, rel=1e-5)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_gradient_that_is_not_finite_stops_training(value: float) -> None:
    parameter = nn.Parameter(torch.zeros(2))
    parameter.grad = torch.tensor([0.0, value])
    with pytest.raises(TrainingDiverged):
        clip_gradients([parameter], 0.5)


def actor_parameters(start: dict[str, Tensor], agent: int) -> dict[str, nn.Parameter]:
    """Parameters of one agent's actor: a perceptron with one hidden layer, and its log standard deviations."""
    return {name: nn.Parameter(tensor[agent].clone()) for name, tensor in start.items()}


def log_prob(actor: dict[str, nn.Parameter], observations: Tensor, actions: Tensor) -> Tensor:
    hidden = torch.tanh(observations @ actor["network.0.weight"] + actor["network.0.bias"])
    mean = hidden @ actor["network.2.weight"] + actor["network.2.bias"]
    return Normal(mean, actor["log_std"].exp()).log_prob(actions).sum(-1)


def start_of(policy: ActorCritic) -> dict[str, Tensor]:
    return {name: parameter.detach().clone() for name, parameter in policy.actor.named_parameters()}


def test_mappo_update_equals_a_plain_implementation() -> None:
    """With one minibatch, whose order does not matter, but several passes, so that ratios leave 1 and are clipped."""
    config = PolicyConfig.named("mappo", **SETTINGS, learning_rate=0.02, clip=0.05, entropy_weight=0.1)
    learner, twin = Learner(IdentityTask(4), config), Learner(IdentityTask(4), config)
    rollout = learner.collect()
    twin.collect()
    # The twin provides the batch and the initial networks.
    assert isinstance(twin.policy, ActorCritic)
    batch, _ = make_batch(twin.policy, rollout, team_rewards(rollout.rewards, rollout), config, config.gamma)
    actors = [actor_parameters(start_of(twin.policy), agent) for agent in range(3)]
    critic = twin.policy.critic
    parameters = [parameter for actor in actors for parameter in actor.values()] + list(critic.parameters())
    adam = torch.optim.Adam(parameters, lr=config.learning_rate, eps=ADAM_EPSILON)
    for _ in range(config.epochs):
        now = torch.stack([log_prob(actors[n], batch.observations[n], batch.actions[n]) for n in range(3)])
        ratio = (now - batch.log_probs).exp()
        surrogate = torch.min(ratio * batch.advantages, ratio.clamp(0.95, 1.05) * batch.advantages).mean()
        entropy = torch.stack([Normal(0.0, actor["log_std"].exp()).entropy().sum() for actor in actors]).mean()
        value_loss = (critic(batch.observations, batch.state) - batch.returns).square().mean()
        adam.zero_grad()
        (-surrogate - 0.1 * entropy + config.value_weight * value_loss).backward()
        nn.utils.clip_grad_norm_(parameters, config.max_gradient_norm)
        adam.step()

    metrics = learner.update(rollout, rollout.rewards)
    assert metrics["clip_fraction"] > 0
    assert isinstance(learner.policy, ActorCritic)
    for agent in range(3):
        for name, tensor in actors[agent].items():
            ours = learner.policy.actor.get_parameter(name)[agent]
            torch.testing.assert_close(ours, tensor, atol=TOLERANCE, rtol=0)
    for ours, tensor in zip(learner.policy.critic.parameters(), critic.parameters(), strict=True):
        torch.testing.assert_close(ours, tensor, atol=TOLERANCE, rtol=0)


def test_happo_update_equals_a_plain_implementation() -> None:
    config = PolicyConfig.named("happo", **SETTINGS, learning_rate=0.02, clip=0.05)
    learner, twin = Learner(IdentityTask(4), config), Learner(IdentityTask(4), config)
    rollout = learner.collect()
    twin.collect()
    # The twin provides the batch and the initial networks; its generator gives the same order of agents.
    assert isinstance(twin.policy, ActorCritic)
    batch, _ = make_batch(twin.policy, rollout, team_rewards(rollout.rewards, rollout), config, config.gamma)
    generator = torch.Generator()
    generator.set_state(twin.state_dict()["learner.generator"])
    order = torch.randperm(3, generator=generator).tolist()
    start = start_of(twin.policy)

    factor = torch.ones(config.steps_per_rollout)
    expected = {}
    for agent in order:
        actor = expected[agent] = actor_parameters(start, agent)
        observations, actions, log_probs = batch.observations[agent], batch.actions[agent], batch.log_probs[agent]
        adam = torch.optim.Adam(actor.values(), lr=config.learning_rate, eps=ADAM_EPSILON)
        for _ in range(config.epochs):
            ratio = (log_prob(actor, observations, actions) - log_probs).exp()
            weighted = factor * batch.advantages[agent]
            adam.zero_grad()
            (-torch.min(ratio * weighted, ratio.clamp(0.95, 1.05) * weighted).mean()).backward()
            nn.utils.clip_grad_norm_(actor.values(), config.max_gradient_norm)
            adam.step()
        factor = factor * (log_prob(actor, observations, actions) - log_probs).exp().detach()
    assert factor.max() > 1.02

    metrics = learner.update(rollout, rollout.rewards)
    assert metrics["clip_fraction"] > 0
    assert isinstance(learner.policy, ActorCritic)
    for agent, parameters in expected.items():
        for name, tensor in parameters.items():
            ours = learner.policy.actor.get_parameter(name)[agent]
            torch.testing.assert_close(ours, tensor, atol=TOLERANCE, rtol=0)


def test_the_surrogate_loss_is_the_mean_over_living_agents() -> None:
    log_ratio, advantages = torch.tensor([[0.02, 0.01], [0.0, 0.0]]), torch.tensor([[1.0, 3.0], [50.0, -70.0]])
    alive = torch.tensor([[1.0, 1.0], [0.0, 0.0]])
    loss = clipped_surrogate_loss(log_ratio, advantages, 0.1, alive)
    torch.testing.assert_close(loss, clipped_surrogate_loss(log_ratio[:1], advantages[:1], 0.1))
    assert clipped_surrogate_loss(log_ratio, advantages, 0.1, torch.zeros(2, 2)) == 0


@pytest.mark.parametrize("algorithm", ["mappo", "happo", "mat"])
def test_dead_agents_do_not_train_the_actors(algorithm: Algorithm) -> None:
    config = PolicyConfig.named(algorithm, n_envs=4, rollout_steps=30, epochs=1, minibatches=2, device="cpu")
    learners = [Learner(make_task("3m", 4), config) for _ in range(2)]
    batches = []
    for learner in learners:
        rollout = learner.collect()
        batches.append(
            make_batch(learner.policy, rollout, team_rewards(rollout.rewards, rollout), config, config.gamma)[0]
        )
    dead = batches[0].alive == 0
    assert 0 < dead.float().mean() < 1
    assert batches[0].available is not None
    assert torch.equal(dead, batches[0].available.sum(-1) == 1)
    counted = batches[0].advantages[~dead]
    assert counted.mean().abs() < 1e-5
    assert counted.std() == pytest.approx(1.0, rel=1e-2)
    changed = replace(batches[1], advantages=torch.where(dead, 1000.0, batches[1].advantages))
    metrics = [
        make_update(learner.policy, config).run(batch, torch.Generator().manual_seed(0))
        for learner, batch in zip(learners, (batches[0], changed), strict=True)
    ]
    assert metrics[0][0]["actor_loss"] == metrics[1][0]["actor_loss"]
    for ours, theirs in zip(*(learner.policy.parameters() for learner in learners), strict=True):
        assert torch.equal(ours, theirs)
