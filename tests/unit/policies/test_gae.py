"""Advantages against their definition, summed step by step."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapt.policies.ppo import advantages

pytestmark = pytest.mark.numerics


def slow_advantages(rewards, values, next_values, terminated, truncated, gamma, gae_lambda) -> np.ndarray:
    """Sum over the steps k to the end of the episode or rollout of (gamma * lambda)^k times the surprise."""
    n_steps, n_envs, n_agents = rewards.shape
    result = np.zeros_like(rewards)
    for t in range(n_steps):
        for env in range(n_envs):
            for agent in range(n_agents):
                for k in range(t, n_steps):
                    future = 0.0 if terminated[k, env] else gamma * next_values[k, env, agent]
                    surprise = rewards[k, env, agent] + future - values[k, env, agent]
                    result[t, env, agent] += (gamma * gae_lambda) ** (k - t) * surprise
                    if terminated[k, env] or truncated[k, env]:
                        break
    return result


@given(
    seed=st.integers(0, 2**32 - 1),
    n_steps=st.integers(1, 9),
    gamma=st.floats(0, 1),
    gae_lambda=st.floats(0, 1),
    ends=st.floats(0, 0.6),
)
@settings(max_examples=60, deadline=None)
def test_advantages_equal_the_slow_sum(seed, n_steps, gamma, gae_lambda, ends) -> None:
    rng = np.random.default_rng(seed)
    rewards, values, next_values = rng.normal(size=(3, n_steps, 3, 2))
    terminated = rng.random((n_steps, 3)) < ends
    truncated = (rng.random((n_steps, 3)) < ends) & ~terminated
    ours = advantages(rewards, values, next_values, terminated, truncated, gamma=gamma, gae_lambda=gae_lambda)
    slow = slow_advantages(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
    np.testing.assert_allclose(ours, slow, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("terminated", "expected"), [(True, 1.0), (False, 1.0 + 0.9 * 10.0)])
def test_only_truncation_counts_the_value_of_the_last_state(terminated: bool, expected: float) -> None:
    one = np.ones((1, 1, 1))
    ended = np.array([[terminated]])
    result = advantages(one, 0 * one, 10 * one, ended, ~ended, gamma=0.9, gae_lambda=0.5)
    assert result.item() == pytest.approx(expected)


def test_the_next_episode_does_not_reach_back() -> None:
    rewards, zeros = np.array([1.0, 100.0]).reshape(2, 1, 1), np.zeros((2, 1, 1))
    truncated = np.array([[True], [False]])
    result = advantages(rewards, zeros, zeros, ~truncated & False, truncated, gamma=0.9, gae_lambda=0.9)
    np.testing.assert_allclose(result.ravel(), [1.0, 100.0])
