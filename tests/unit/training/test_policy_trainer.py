import numpy as np

from learning.identity_task import IdentityTask
from mapt.policies import Learner, PolicyConfig
from mapt.training.policy_trainer import PolicyTrainer


def trainer() -> PolicyTrainer:
    config = PolicyConfig(n_envs=4, rollout_steps=8, minibatches=1, epochs=1, hidden=(8,), device="cpu")
    return PolicyTrainer(Learner(IdentityTask(4, 8), config))


def test_training_ends_at_its_steps_or_when_the_callback_returns_true():
    trained, seen = trainer(), []

    def record(rollout, metrics) -> bool:
        seen.append(trained.steps)
        return trained.steps >= 96

    trained.train(64, record)
    assert seen == [32, 64]
    trained.train(10_000, record)
    assert seen == [32, 64, 96]
    assert trained.iteration == 3


def test_update_equals_collecting_relabelling_and_updating_by_hand():
    policy_trainer, by_hand = trainer(), trainer().learner
    metrics = policy_trainer.update(policy_trainer.collect())
    rollout = by_hand.collect()
    by_hand.update(rollout, rollout.rewards)
    for name, tensor in by_hand.state_dict().items():
        assert np.array_equal(tensor, policy_trainer.learner.state_dict()[name])
    assert metrics["true_reward_correlation"] > 0.999
    assert policy_trainer.seconds.total > 0
