"""Rollouts that are collected slot by slot."""

from dataclasses import fields, replace

import numpy as np
import pytest

from mapt.errors import InvalidConfig
from mapt.policies import Learner, PolicyConfig, Rollout
from mapt.policies.slots import joined
from mapt.tasks import make_task

CONFIG = PolicyConfig(
    n_envs=6, collectors=3, rollout_steps=20, minibatches=2, epochs=1, hidden=(8,), seed=4, device="cpu"
)


def learner(config: PolicyConfig = CONFIG) -> Learner:
    return Learner(make_task("Reacher-2x1", config.envs_per_collector), config)


def assert_equal(one: Rollout, other: Rollout) -> None:
    for field in fields(Rollout):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name), err_msg=field.name)


def train(trained: Learner, iterations: int) -> Rollout:
    """The last of several rollouts, each with an update. Episodes of the reacher have 50 steps."""
    for _ in range(iterations):
        rollout = trained.collect()
        trained.update(rollout, rollout.rewards)
    return rollout


def test_a_restored_learner_collects_the_same_rollouts() -> None:
    one, other = learner(), learner()
    train(one, 3)
    other.load_state_dict(one.state_dict())
    assert_equal(one.collect(), other.collect())
    assert_equal(train(one, 2), train(Learner.from_bytes(other.to_bytes(), other.task), 2))


def test_slots_have_different_episodes_and_actions() -> None:
    rollout = learner().collect()
    assert rollout.rewards.shape == (20, 6)
    for name in ("qpos", "sampled_actions"):
        assert len({getattr(rollout, name)[0, env].tobytes() for env in range(6)}) == 6


def test_episodes_continue_from_rollout_to_rollout() -> None:
    trained = learner()
    rollouts = [trained.collect() for _ in range(6)]
    starts = np.concatenate([each.episode_start for each in rollouts])
    assert starts.nonzero()[0].tolist() == [0] * 6 + [50] * 6 + [100] * 6
    rewards = np.concatenate([each.rewards for each in rollouts])
    np.testing.assert_allclose(rollouts[2].episode_returns, rewards[:50].sum(0), rtol=1e-12)


def test_returns_are_in_the_order_in_which_episodes_end() -> None:
    early, late = (learner(replace(CONFIG, n_envs=1, collectors=1)).collect() for _ in range(2))
    truncated = [np.zeros((20, 1), dtype=bool) for _ in range(2)]
    truncated[0][[3, 9]], truncated[1][[1, 5]] = True, True
    ended = [
        replace(rollout, truncated=at, episode_returns=np.array(returns))
        for rollout, at, returns in zip((early, late), truncated, ([3.0, 9.0], [1.0, 5.0]), strict=True)
    ]
    assert joined(ended).episode_returns.tolist() == [1.0, 3.0, 5.0, 9.0]


@pytest.mark.parametrize("settings", [{"n_envs": 32, "collectors": 3}, {"collectors": -1}])
def test_collectors_divide_the_environments(settings: dict[str, int]) -> None:
    with pytest.raises(InvalidConfig) as refused:
        PolicyConfig.from_dict(settings)
    assert refused.value.field == "collectors"


def test_the_task_has_the_environments_of_one_slot() -> None:
    with pytest.raises(InvalidConfig) as refused:
        Learner(make_task("Reacher-2x1", CONFIG.n_envs), CONFIG)
    assert refused.value.field == "n_envs"
