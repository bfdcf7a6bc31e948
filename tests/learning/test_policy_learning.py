"""The learner learns what it should, the same each time, and goes on exactly where it stopped."""

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

HORIZON_STEPS = 8
CONFIG = PolicyConfig(
    n_envs=32, rollout_steps=16, minibatches=4, epochs=8, learning_rate=2e-3, hidden=(32,), seed=1, device="cpu"
)
ALGORITHMS = ("mappo", "happo", "mat", "mat_dec")


def of_algorithm(algorithm: str, **settings: object) -> PolicyConfig:
    """Small and quick."""
    small = {"n_envs": 32, "rollout_steps": 16, "minibatches": 4, "epochs": 5, "hidden": [32], "width": 16, "seed": 1}
    return PolicyConfig.named(algorithm, **{"learning_rate": 3e-3, "device": "cpu", **small, **settings})


def trained(config: PolicyConfig, reward=true_reward, total_steps: int = 20_000) -> Learner:
    learner = Learner(IdentityTask(config.n_envs, HORIZON_STEPS), config)
    train(learner, reward, total_steps)
    return learner


def returns(learner: Learner) -> np.ndarray:
    return evaluate(learner, IdentityTask(32, HORIZON_STEPS), episodes=256)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_learns_to_say_what_is_seen(algorithm: str) -> None:
    """Saying zero gets 2/3 a step, saying the number 1; the learner must close eight tenths of the gap."""
    mean = returns(trained(of_algorithm(algorithm), total_steps=8_000)).mean() / HORIZON_STEPS
    assert mean > 2 / 3 + 0.8 / 3


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_learns_to_choose_what_is_shown(algorithm: str) -> None:
    """The task refuses an action that is not available, so none was drawn in thousands of steps."""
    config = of_algorithm(algorithm)
    learner = Learner(ChoiceTask(config.n_envs), config)
    train(learner, true_reward, total_steps=6_000)
    task = ChoiceTask(32)
    mean = evaluate(learner, task, episodes=128).mean() / task.spec.horizon_steps
    assert mean > ChoiceTask.CHANCE + 0.8 * (1 - ChoiceTask.CHANCE)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("task_type", [IdentityTask, ChoiceTask])
def test_every_algorithm_goes_on_exactly_where_it_stopped(
    algorithm: str, task_type: type[IdentityTask] | type[ChoiceTask], tmp_path: Path
) -> None:
    """After a new reward was announced, in the midst of episodes; every tensor is equal to the bit."""
    config = of_algorithm(algorithm, n_envs=4, rollout_steps=5, minibatches=2, anneal_steps=200)

    def go_on(learner: Learner, rollouts: int) -> None:
        train(learner, true_reward, learner.steps + rollouts * config.steps_per_rollout)

    whole = Learner(task_type(4), config)
    go_on(whole, 3)
    whole.reward_changed()
    whole.save(tmp_path / "policy.safetensors")
    resumed = Learner.load(tmp_path / "policy.safetensors", task_type(4))
    go_on(whole, 4)
    go_on(resumed, 4)
    expected = whole.state_dict()
    assert resumed.state_dict().keys() == expected.keys()
    for name, tensor in resumed.state_dict().items():
        assert torch.equal(tensor, expected[name]), name


@pytest.mark.parametrize("shared_actor", [True, False])
def test_agents_learn_to_say_what_they_see(shared_actor: bool) -> None:
    """Saying zero gets 2/3 a step, saying the number 1; the learner must close nine tenths of the gap."""
    mean = returns(trained(replace(CONFIG, shared_actor=shared_actor))).mean() / HORIZON_STEPS
    assert mean > 2 / 3 + 0.9 / 3


def test_agents_of_their_own_learn_from_rewards_of_their_own() -> None:
    """Agent 0 is paid for the number, agent 1 for its opposite, agent 2 for silence."""
    signs = np.array([1.0, -1.0, 0.0])

    def individual(rollout: Rollout) -> np.ndarray:
        return -np.square(rollout.actions[..., 0] - signs * rollout.state)

    learner = trained(replace(CONFIG, shared_actor=False), individual)
    seen = np.zeros((2, 3, 2), dtype=np.float32)
    seen[..., 0], seen[..., 1] = [[0.6] * 3, [-0.6] * 3], 0.5
    np.testing.assert_allclose(learner.policy.act(seen)[..., 0], 0.6 * np.outer([1, -1], signs), atol=0.15)


def test_another_reward_teaches_another_behaviour() -> None:
    learner = trained(CONFIG, lambda rollout: -rollout.rewards, total_steps=10_000)
    assert returns(learner).mean() / HORIZON_STEPS < 0.5


@pytest.mark.parametrize("tell", [True, False])
def test_learning_survives_a_reward_whose_scale_jumps(tell: bool) -> None:
    learner = Learner(IdentityTask(CONFIG.n_envs, HORIZON_STEPS), CONFIG)
    for factor, offset, until in ((1.0, 0.0, 6_000), (1e3, -50.0, 12_000), (1e-2, 3.0, 24_000)):
        if tell:
            learner.reward_changed()
        train(learner, lambda rollout, factor=factor, offset=offset: factor * rollout.rewards + offset, until)
    assert returns(learner).mean() / HORIZON_STEPS > 2 / 3 + 0.9 / 3


def cheetahs(n_envs: int) -> Task:
    return make_task("HalfCheetah-6x1", n_envs, n_threads=2)


CHEETAH = PolicyConfig(n_envs=8, rollout_steps=64, minibatches=2, epochs=2, anneal_steps=50_000, device="cpu")


def test_a_seed_decides_everything() -> None:
    def state(seed: int) -> dict[str, torch.Tensor]:
        learner = Learner(cheetahs(8), replace(CHEETAH, seed=seed))
        train(learner, true_reward, total_steps=4 * CHEETAH.steps_per_rollout)
        return learner.state_dict()

    first, again, other = state(0), state(0), state(1)
    assert all(torch.equal(tensor, again[name]) for name, tensor in first.items())
    assert any(not torch.equal(tensor, other[name]) for name, tensor in first.items() if name.startswith("actor"))


@pytest.mark.parametrize("shared_actor", [True, False])
@pytest.mark.parametrize("stop_after_updates", [1, 15])
def test_a_resumed_run_equals_one_that_never_stopped(
    shared_actor: bool, stop_after_updates: int, tmp_path: Path
) -> None:
    """18 rollouts of 64 steps, so that episodes end and begin after the stop; every tensor is equal to the bit."""
    config = replace(CHEETAH, shared_actor=shared_actor)
    total_steps = 18 * config.steps_per_rollout
    whole = Learner(cheetahs(8), config)
    ends: list[np.ndarray] = []
    train(whole, true_reward, total_steps, lambda rollout: ends.append(rollout.episode_returns))

    stopped = Learner(cheetahs(8), config)
    train(stopped, true_reward, stop_after_updates * config.steps_per_rollout)
    stopped.save(tmp_path / "policy.safetensors")
    del stopped
    resumed = Learner.load(tmp_path / "policy.safetensors", cheetahs(8))
    resumed_ends: list[np.ndarray] = []
    train(resumed, true_reward, total_steps, lambda rollout: resumed_ends.append(rollout.episode_returns))

    np.testing.assert_array_equal(np.concatenate(resumed_ends), np.concatenate(ends))
    assert len(np.concatenate(ends)) == 8
    expected = whole.state_dict()
    for name, tensor in resumed.state_dict().items():
        assert torch.equal(tensor, expected[name]), name
