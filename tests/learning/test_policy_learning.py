"""Every algorithm learns, training is deterministic under a seed, and checkpoints resume exactly."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from learning.choice_task import ChoiceTask
from learning.identity_task import IdentityTask
from mapt.policies import Learner, PolicyConfig, Rollout, evaluate
from mapt.tasks import Task, make_task
from support.policy_training import train, true_reward

pytestmark = pytest.mark.slow

HORIZON_STEPS = 8
CONFIG = PolicyConfig(
    n_envs=32, rollout_steps=16, minibatches=4, epochs=8, learning_rate=2e-3, hidden=(32,), seed=1, device="cpu"
)
ALGORITHMS = ("mappo", "happo", "mat", "mat_dec")


def small_config(algorithm: str, **settings: object) -> PolicyConfig:
    """A small, quick configuration."""
    small = {"n_envs": 32, "rollout_steps": 16, "minibatches": 4, "epochs": 5, "hidden": [32], "width": 16, "seed": 1}
    return PolicyConfig.named(algorithm, **{"learning_rate": 3e-3, "device": "cpu", **small, **settings})


def train_identity(config: PolicyConfig, reward=true_reward, total_steps: int = 20_000) -> Learner:
    learner = Learner(IdentityTask(config.n_envs, HORIZON_STEPS), config)
    train(learner, reward, total_steps)
    return learner


def returns(learner: Learner) -> np.ndarray:
    return evaluate(learner, IdentityTask(32, HORIZON_STEPS), episodes=256)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_learns_the_identity_task(algorithm: str) -> None:
    """Actions of zero get 2/3 per step, the best ones 1; the learner closes at least 80% of the gap."""
    mean = returns(train_identity(small_config(algorithm), total_steps=8_000)).mean() / HORIZON_STEPS
    assert mean > 2 / 3 + 0.8 / 3


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_learns_the_choice_task(algorithm: str) -> None:
    """The task raises an error for unavailable actions, so this also tests that none is sampled."""
    config = small_config(algorithm)
    learner = Learner(ChoiceTask(config.n_envs), config)
    train(learner, true_reward, total_steps=6_000)
    task = ChoiceTask(32)
    mean = evaluate(learner, task, episodes=128).mean() / task.spec.horizon_steps
    assert mean > ChoiceTask.CHANCE + 0.8 * (1 - ChoiceTask.CHANCE)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("task_type", [IdentityTask, ChoiceTask])
def test_every_algorithm_resumes_exactly(
    algorithm: str, task_type: type[IdentityTask] | type[ChoiceTask], tmp_path: Path
) -> None:
    """Training stops within an episode, after `reward_changed`; every tensor is bit-identical.

    The policy starts anew in the iteration after the checkpoint.
    """
    config = small_config(
        algorithm, n_envs=4, rollout_steps=5, minibatches=2, anneal_steps=200, target_kl=1e-4, restart_steps=60
    )

    def continue_training(learner: Learner, rollouts: int) -> None:
        train(learner, true_reward, learner.steps + rollouts * config.steps_per_rollout)

    whole = Learner(task_type(4), config)
    continue_training(whole, 3)
    whole.reward_changed()
    whole.save(tmp_path / "policy.safetensors")
    resumed = Learner.load(tmp_path / "policy.safetensors", task_type(4))
    continue_training(whole, 4)
    continue_training(resumed, 4)
    expected = whole.state_dict()
    assert resumed.state_dict().keys() == expected.keys()
    for name, tensor in resumed.state_dict().items():
        assert torch.equal(tensor, expected[name]), name


@pytest.mark.parametrize("shared_actor", [True, False])
def test_mappo_learns_the_identity_task(shared_actor: bool) -> None:
    """Actions of zero get 2/3 per step, the best ones 1; the learner closes at least 90% of the gap."""
    mean = returns(train_identity(replace(CONFIG, shared_actor=shared_actor))).mean() / HORIZON_STEPS
    assert mean > 2 / 3 + 0.9 / 3


def test_individual_rewards_teach_each_agent_its_own_behaviour() -> None:
    """Agent 0 is rewarded for the number it observes, agent 1 for its negative, agent 2 for zero."""
    signs = np.array([1.0, -1.0, 0.0])

    def individual(rollout: Rollout) -> np.ndarray:
        return -np.square(rollout.actions[..., 0] - signs * rollout.state)

    learner = train_identity(replace(CONFIG, shared_actor=False), individual)
    observations = np.zeros((2, 3, 2), dtype=np.float32)
    observations[..., 0], observations[..., 1] = [[0.6] * 3, [-0.6] * 3], 0.5
    np.testing.assert_allclose(learner.policy.act(observations)[..., 0], 0.6 * np.outer([1, -1], signs), atol=0.15)


def test_negated_reward_teaches_the_opposite_behaviour() -> None:
    learner = train_identity(CONFIG, lambda rollout: -rollout.rewards, total_steps=10_000)
    assert returns(learner).mean() / HORIZON_STEPS < 0.5


@pytest.mark.parametrize("announced", [True, False])
def test_training_succeeds_when_the_scale_of_the_reward_changes(announced: bool) -> None:
    learner = Learner(IdentityTask(CONFIG.n_envs, HORIZON_STEPS), CONFIG)
    for factor, offset, until in ((1.0, 0.0, 6_000), (1e3, -50.0, 12_000), (1e-2, 3.0, 24_000)):
        if announced:
            learner.reward_changed()
        train(learner, lambda rollout, factor=factor, offset=offset: factor * rollout.rewards + offset, until)
    assert returns(learner).mean() / HORIZON_STEPS > 2 / 3 + 0.9 / 3


def cheetah_task(n_envs: int) -> Task:
    return make_task("HalfCheetah-6x1", n_envs, n_threads=2)


CHEETAH = PolicyConfig(n_envs=8, rollout_steps=64, minibatches=2, epochs=2, anneal_steps=50_000, device="cpu")


def test_same_seed_gives_identical_weights() -> None:
    def state(seed: int) -> dict[str, torch.Tensor]:
        learner = Learner(cheetah_task(8), replace(CHEETAH, seed=seed))
        train(learner, true_reward, total_steps=4 * CHEETAH.steps_per_rollout)
        return learner.state_dict()

    first, again, other = state(0), state(0), state(1)
    assert all(torch.equal(tensor, again[name]) for name, tensor in first.items())
    assert any(not torch.equal(tensor, other[name]) for name, tensor in first.items() if name.startswith("actor"))


@pytest.mark.parametrize("shared_actor", [True, False])
@pytest.mark.parametrize("stop_after_updates", [1, 15])
def test_resumed_run_equals_an_uninterrupted_run(shared_actor: bool, stop_after_updates: int, tmp_path: Path) -> None:
    """Episodes of 1,000 steps end within the 18 rollouts of 64 steps; every tensor is bit-identical."""
    config = replace(CHEETAH, shared_actor=shared_actor)
    total_steps = 18 * config.steps_per_rollout
    whole = Learner(cheetah_task(8), config)
    episode_returns: list[np.ndarray] = []
    train(whole, true_reward, total_steps, lambda rollout: episode_returns.append(rollout.episode_returns))

    stopped = Learner(cheetah_task(8), config)
    train(stopped, true_reward, stop_after_updates * config.steps_per_rollout)
    stopped.save(tmp_path / "policy.safetensors")
    del stopped
    resumed = Learner.load(tmp_path / "policy.safetensors", cheetah_task(8))
    resumed_returns: list[np.ndarray] = []
    train(resumed, true_reward, total_steps, lambda rollout: resumed_returns.append(rollout.episode_returns))

    np.testing.assert_array_equal(np.concatenate(resumed_returns), np.concatenate(episode_returns))
    assert len(np.concatenate(episode_returns)) == 8
    expected = whole.state_dict()
    for name, tensor in resumed.state_dict().items():
        assert torch.equal(tensor, expected[name]), name
