import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapt.errors import InvalidConfig, InvalidRollout
from mapt.rewards.config import RewardConfig
from mapt.rewards.registry import build_reward_model
from mapt.rewards.relabelling import RewardStream, RolloutRelabeller
from support.tolerance import assert_float32_close

pytestmark = pytest.mark.numerics

N_ENVS, N_AGENTS, OBSERVATION_DIM, ACTION_DIM = 3, 3, 4, 2
# The fixtures are the same for every example.
each_example = settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])


def draw(n_steps, start_rate=0.1, seed=0):
    rng = np.random.default_rng(seed)
    shape = (n_steps, N_ENVS, N_AGENTS)
    start = rng.random((n_steps, N_ENVS)) < start_rate
    return (
        rng.normal(size=(*shape, OBSERVATION_DIM)).astype(np.float32),
        rng.normal(size=(*shape, ACTION_DIM)).astype(np.float32),
        start,
    )


def streamed(stream, observations, actions, start):
    return np.stack([stream.step(*step) for step in zip(observations, actions, start, strict=True)])


@each_example
@given(st.integers(1, 40), st.integers(1, 9), st.floats(0, 0.3), st.integers(0, 99))
def test_streamed_rewards_equal_relabelled_rewards(build, variant, n_steps, window, start_rate, seed):
    model = build(**variant)
    model.set_reward_scale(0.3, 1.7)
    rollout = draw(n_steps, start_rate, seed)
    relabelled = RolloutRelabeller(model, window, N_ENVS, "individual").relabel(*rollout)
    assert_float32_close(streamed(RewardStream(model, window, N_ENVS, "individual"), *rollout), relabelled)


@pytest.mark.parametrize("kind", ["attended", "weighted"])
@pytest.mark.parametrize("credit", ["shared", "individual"])
def test_each_kind_of_reward_streams_as_relabelled(build, kind, credit):
    model, rollout = build(), draw(12)
    relabelled = RolloutRelabeller(model, 5, N_ENVS, credit, kind=kind).relabel(*rollout)
    assert_float32_close(streamed(RewardStream(model, 5, N_ENVS, credit, kind=kind), *rollout), relabelled)


@pytest.mark.parametrize("name", ["MA-MLP", "MA-LSTM", "MA-Transformer"])
def test_each_baseline_streams_as_relabelled(name):
    config = RewardConfig.named(
        name,
        preset="small",
        observation_dim=OBSERVATION_DIM,
        action_dim=ACTION_DIM,
        n_agents=N_AGENTS,
        segment_steps=5,
    )
    model, rollout = build_reward_model(config), draw(12)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)) * 0.3)
    relabelled = RolloutRelabeller(model, 5, N_ENVS).relabel(*rollout)
    assert_float32_close(streamed(RewardStream(model, 5, N_ENVS), *rollout), relabelled)


def test_positions_stay_exact_after_thousands_of_steps(build):
    model = build()
    observations, actions, start = draw(3_000, start_rate=0)
    stream = RewardStream(model, 4, N_ENVS)
    last = streamed(stream, observations, actions, start)[-1]
    window = RolloutRelabeller(model, 4, N_ENVS).relabel(observations[-4:], actions[-4:], start[-4:])
    assert_float32_close(last, window[-1])


@pytest.mark.parametrize("settings", [{}, {"temporal": "lstm"}])
def test_malformed_step_is_refused_and_ignored(build, settings):
    model = build(**settings)
    observations, actions, start = draw(6)
    stream, reference = (RewardStream(model, 4, N_ENVS) for _ in range(2))
    streamed(stream, observations[:5], actions[:5], start[:5])
    streamed(reference, observations[:5], actions[:5], start[:5])
    for step in (
        (observations[5, :2], actions[5], start[5]),
        (observations[5] * np.nan, actions[5], start[5]),
        (observations[5], actions[5, ..., :1], start[5]),
        (observations[5], actions[5], start[5, :1]),
    ):
        with pytest.raises(InvalidRollout):
            stream.step(*step)
    np.testing.assert_array_equal(
        stream.step(observations[5], actions[5], start[5]), reference.step(observations[5], actions[5], start[5])
    )


def test_unknown_kind_is_refused(build):
    with pytest.raises(InvalidConfig) as error:
        RewardStream(build(), 4, N_ENVS, kind="guessed")
    assert error.value.field == "kind"
