"""MAGAIL's discriminators: their loss and gradient penalty, what they tell apart, and resuming."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from learning.identity_task import N_AGENTS, IdentityTask
from mapt.errors import CheckpointMismatch, TrainingDiverged
from mapt.imitation.config import MagailConfig
from mapt.imitation.demonstrations import Demonstrations
from mapt.imitation.magail import DiscriminatorReward, Discriminators, clone_first, discriminator_loss, gradient_penalty
from mapt.policies import Learner, PolicyConfig, Rollout, evaluate
from support.tolerance import assert_float32_close

POLICY = PolicyConfig(n_envs=8, rollout_steps=32, minibatches=2, epochs=4, hidden=(16,), initial_log_std=-1.0)
CONFIG = MagailConfig(batch=64, hidden=16, steps_per_rollout=2, cloning_steps=0)


def rollout(gain: float, seed: int = 0) -> Rollout:
    """A rollout in which each agent outputs `gain` times the number it observes."""
    collected = Learner(IdentityTask(8), replace(POLICY, seed=seed)).collect()
    return replace(collected, actions=gain * collected.observations[..., :1])


def demonstrations() -> Demonstrations:
    return Demonstrations.from_rollout(rollout(1.0, seed=1))


def reward(config: MagailConfig = CONFIG, **changes) -> DiscriminatorReward:
    return DiscriminatorReward(demonstrations(), IdentityTask(1).spec, config, seed=0, **changes)


@pytest.mark.numerics
def test_the_gradient_penalty_equals_finite_differences():
    discriminators = Discriminators(IdentityTask(1).spec, 5).double()
    inputs = torch.randn(N_AGENTS, 4, 7, dtype=torch.float64)

    def score(x: Tensor) -> Tensor:
        return torch.tanh(discriminators.network(x)[..., 0])

    found = gradient_penalty(score, inputs).detach().numpy()
    step = 1e-6
    with torch.no_grad():
        partial = [
            (score(inputs + step * unit) - score(inputs - step * unit)) / (2 * step)
            for unit in torch.eye(7, dtype=torch.float64)
        ]
    norms = torch.stack(partial, -1).norm(dim=-1)
    np.testing.assert_allclose(found, (norms - 1).square().mean(-1).numpy(), rtol=1e-5)


def test_the_gradient_penalty_of_a_linear_score_is_known():
    weights = torch.tensor([[3.0, 4.0], [0.6, 0.8]])
    found = gradient_penalty(lambda x: (x * weights[:, None]).sum(-1), torch.randn(2, 9, 2))
    torch.testing.assert_close(found, torch.tensor([16.0, 0.0]))


@pytest.mark.numerics
def test_the_loss_equals_a_loop_over_agents():
    discriminators = Discriminators(IdentityTask(1).spec, 5)
    policy, demonstrated, mix = torch.randn(3, 4, 7), torch.randn(3, 4, 7), torch.rand(1, 4, 1)
    loss, gap = discriminator_loss(discriminators, policy, demonstrated, mix, 5.0)
    expected, gaps = 0.0, []
    for agent in range(3):

        def score(row: Tensor, agent: int = agent) -> Tensor:
            hidden = row
            for layer in discriminators.network:
                own = hasattr(layer, "weight")
                hidden = hidden @ layer.weight[agent] + layer.bias[agent, 0] if own else layer(hidden)  # pyright: ignore[reportIndexIssue, reportOperatorIssue]
            return hidden[0]

        gaps.append(
            sum(
                float(score(demonstrated[agent, b]).detach()) - float(score(policy[agent, b]).detach())
                for b in range(4)
            )
            / 4
        )
        for b in range(4):
            point = (policy[agent, b] + mix[0, b] * (demonstrated[agent, b] - policy[agent, b])).requires_grad_()
            (gradient,) = torch.autograd.grad(score(point), point)
            expected += 5.0 * (float(gradient.norm()) - 1.0) ** 2 / 4
    assert_float32_close(loss.detach().numpy(), expected - sum(gaps))
    assert_float32_close(gap.numpy(), np.mean(gaps))


def test_discriminators_tell_two_policies_apart():
    source = reward(replace(CONFIG, steps_per_rollout=150, learning_rate=3e-3))
    wrong, right = rollout(-1.0), rollout(1.0, seed=2)
    of_wrong = source.rewards(wrong)
    assert of_wrong.shape == (32, 8, N_AGENTS)
    assert source.metrics()["discriminator_gap"] > 0.1
    inputs = Demonstrations.from_rollout(right)
    with torch.no_grad():
        of_right = source.discriminators(source.discriminators.inputs(inputs.observations, inputs.actions))
    # For every agent, fresh steps of the demonstrated policy score higher.
    better = of_right.mean(1).numpy() - of_wrong.mean(axis=(0, 1))
    assert (better > 0.3).all()


def test_rewards_belong_to_their_steps():
    played, source = rollout(0.5), reward()
    found = source.rewards(played)
    with torch.no_grad():
        for step, env in ((0, 0), (5, 3), (31, 7)):
            observations, actions = (
                torch.from_numpy(each[step, env])[:, None] for each in (played.observations, played.actions)
            )
            expected = source.discriminators(source.discriminators.inputs(observations, actions))[:, 0]
            assert_float32_close(found[step, env], expected.numpy())


@pytest.mark.slow
def test_a_policy_learns_what_was_demonstrated():
    """The true reward is not read; actions of zero have a return of 5.3 of 8."""
    learner = Learner(IdentityTask(8), POLICY)
    source = reward(MagailConfig(batch=128, hidden=32, steps_per_rollout=8, learning_rate=3e-3, cloning_steps=0))
    for _ in range(40):
        played = learner.collect()
        learner.update(replace(played, rewards=np.full_like(played.rewards, np.nan)), source.rewards(played))
    assert evaluate(learner.policy, IdentityTask(8), 64).mean() > 6.8


def test_training_starts_from_cloning():
    learner = Learner(IdentityTask(8), POLICY)
    before = evaluate(learner.policy, IdentityTask(8), 64).mean()
    clone_first(learner.policy, demonstrations(), MagailConfig(cloning_steps=150), seed=0)
    assert evaluate(learner.policy, IdentityTask(8), 64).mean() > before + 0.7


def test_rewards_resume_exactly():
    first, whole = rollout(0.5), reward()
    whole.rewards(first)
    resumed = reward(context=whole.context())
    second = rollout(0.2, seed=3)
    np.testing.assert_array_equal(resumed.rewards(second), whole.rewards(second))
    assert resumed.context().keys() == whole.context().keys()
    with pytest.raises(CheckpointMismatch):
        reward(replace(CONFIG, hidden=8), context=whole.context())


def test_a_gradient_that_is_not_finite_changes_nothing():
    source, played = reward(), rollout(0.5)
    before = [each.clone() for each in source.discriminators.parameters()]
    with pytest.raises(TrainingDiverged):
        source.rewards(replace(played, actions=np.full_like(played.actions, np.nan)))
    assert all(map(torch.equal, before, source.discriminators.parameters()))
