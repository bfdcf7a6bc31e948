"""Behavioural cloning of policies of every algorithm."""

import numpy as np
import pytest
import torch

from learning.choice_task import ChoiceTask
from learning.identity_task import IdentityTask
from mapt.errors import TrainingDiverged
from mapt.imitation.cloning import CloningTrainer, cloning_loss
from mapt.imitation.config import CloningConfig
from mapt.imitation.demonstrations import Demonstrations
from mapt.policies import Learner, Policy, PolicyConfig, evaluate


def identity_data(n_steps: int = 2000) -> Demonstrations:
    """Steps in which each agent outputs the number it observes."""
    targets = np.random.default_rng(0).uniform(-1, 1, (1, n_steps, 3, 1)).astype(np.float32)
    observations = np.concatenate([targets, np.full_like(targets, 0.5)], axis=-1)
    return Demonstrations.from_segments(observations, targets, np.ones((1, n_steps), bool))


def untrained(algorithm: str = "mappo") -> Policy:
    config = PolicyConfig.named(algorithm, n_envs=4, rollout_steps=8, minibatches=1, hidden=[32], width=16)
    return Learner(IdentityTask(4), config).policy


@pytest.mark.parametrize("algorithm", ["mappo", "mat"])
def test_a_cloned_policy_repeats_the_stored_actions(algorithm):
    policy = untrained(algorithm)
    trainer = CloningTrainer(policy, identity_data(), CloningConfig(batch=128, learning_rate=5e-3), seed=0)
    losses = [float(trainer.step()["cloning_loss"]) for _ in range(200)]
    assert losses[-1] < losses[0] - 1
    # An episode has 8 steps; actions of zero have a return of 5.3.
    assert evaluate(policy, IdentityTask(8), 32).mean() > 7.8


def test_the_standard_deviation_stays_at_its_minimum():
    policy = untrained()
    config = CloningConfig(batch=64, learning_rate=0.1, min_log_std=-1.0)
    trainer = CloningTrainer(policy, identity_data(), config, seed=0)
    for _ in range(20):
        trainer.step()
    assert policy.action_std() == pytest.approx(np.exp(-1), rel=0.2)
    assert (policy.action_std() or 0) >= np.exp(-1) - 1e-6


def test_the_loss_of_discrete_actions_is_their_cross_entropy():
    policy = Learner(ChoiceTask(4), PolicyConfig(n_envs=4, rollout_steps=8, minibatches=1)).policy
    observations = torch.rand(2, 6, 4)
    actions = torch.eye(4)[torch.randint(4, (2, 6))]
    available = actions.bool() | (torch.rand(2, 6, 4) < 0.5)
    logits = policy.get_submodule("actor.network")(observations).masked_fill(~available, -torch.inf)
    chosen = (logits.log_softmax(-1).nan_to_num(neginf=0) * actions).sum(-1)
    torch.testing.assert_close(cloning_loss(policy, observations, actions, available), -chosen.mean())


def test_training_resumes_exactly():
    whole, resumed = untrained(), untrained()
    trainer = CloningTrainer(whole, identity_data(), CloningConfig(batch=16), seed=1)
    for _ in range(3):
        trainer.step()
    again = CloningTrainer(resumed, identity_data(), CloningConfig(batch=16), seed=2)
    again.load_state_dict(trainer.state_dict())
    resumed.load_state_dict(whole.state_dict())
    assert trainer.step() == again.step()
    for one, other in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(one, other)


def test_a_gradient_that_is_not_finite_changes_nothing():
    policy = untrained()
    trainer = CloningTrainer(policy, identity_data(), CloningConfig(batch=16), seed=0)
    with torch.no_grad():
        next(policy.get_submodule("actor.network").parameters()).fill_(torch.nan)
    before = [each.clone() for each in policy.parameters()]
    with pytest.raises(TrainingDiverged):
        trainer.step()
    for one, other in zip(before, policy.parameters(), strict=True):
        torch.testing.assert_close(one, other, equal_nan=True)
