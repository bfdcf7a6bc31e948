import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapt.errors import ShapeError
from mapt.rewards.config import RewardConfig
from mapt.rewards.mapt import MAPT

pytestmark = pytest.mark.numerics

N_AGENTS, OBSERVATION_DIM, ACTION_DIM = 3, 4, 2
CLOSE = {"rtol": 1e-4, "atol": 1e-4}
# The fixtures are the same for every example.
each_example = settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])


def draw(n_segments, n_steps, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (n_segments, n_steps, N_AGENTS)
    return (
        torch.randn(*shape, OBSERVATION_DIM, generator=generator),
        torch.randn(*shape, ACTION_DIM, generator=generator),
        torch.ones(n_segments, n_steps, dtype=torch.bool),
    )


def test_outputs_have_the_documented_shapes(build, variant):
    output = build(**variant)(*draw(5, 7))
    assert output.agent_rewards.shape == (5, 7, N_AGENTS)
    assert output.rewards.shape == output.weights.shape == (5, 7)
    assert output.score.shape == (5,)


@each_example
@given(st.lists(st.integers(1, 9), min_size=1, max_size=4), st.integers(0, 99))
def test_weights_of_real_steps_sum_to_one(build, variant, lengths, seed):
    observations, actions, _ = draw(len(lengths), 9, seed)
    mask = torch.arange(9) < torch.tensor(lengths)[:, None]
    weights = build(**variant)(observations, actions, mask).weights
    assert (weights >= 0).all()
    assert (weights[~mask] == 0).all()
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(len(lengths)), **CLOSE)


@each_example
@given(st.integers(1, 8), st.integers(1, 5), st.integers(0, 99))
def test_padding_does_not_change_outputs(build, variant, n_steps, n_padding, seed):
    model = build(**variant)
    observations, actions, mask = draw(2, n_steps + n_padding, seed)
    mask[:, n_steps:] = False
    padded = model(observations, actions, mask)
    bare = model(observations[:, :n_steps], actions[:, :n_steps], mask[:, :n_steps])
    torch.testing.assert_close(padded.score, bare.score, **CLOSE)
    torch.testing.assert_close(padded.weights[:, :n_steps], bare.weights, **CLOSE)
    torch.testing.assert_close(padded.agent_rewards[:, :n_steps], bare.agent_rewards, **CLOSE)


@each_example
@given(st.permutations(range(N_AGENTS)), st.integers(1, 8), st.integers(0, 99))
def test_permuting_agents_permutes_their_rewards(build, variant, order, n_steps, seed):
    model = build(**variant)
    observations, actions, mask = draw(2, n_steps, seed)
    permuted = model(observations[:, :, order], actions[:, :, order], mask).agent_rewards
    torch.testing.assert_close(permuted, model(observations, actions, mask).agent_rewards[:, :, order], **CLOSE)


@each_example
@given(st.integers(2, 9), st.integers(1, 8), st.integers(0, 99))
def test_reward_does_not_depend_on_the_future(build, variant, n_steps, at, seed):
    at = min(at, n_steps - 1)
    model = build(**variant)
    observations, actions, mask = draw(2, n_steps, seed)
    before = model(observations, actions, mask).agent_rewards
    observations[:, at:] += 3
    actions[:, at:] -= 3
    after = model(observations, actions, mask).agent_rewards
    torch.testing.assert_close(after[:, :at], before[:, :at], **CLOSE)
    assert not torch.allclose(after[:, at], before[:, at])


@pytest.mark.parametrize("temporal", ["attention", "lstm"])
def test_reward_depends_on_the_past(build, temporal):
    model = build(temporal=temporal)
    observations, actions, mask = draw(2, 6)
    before = model(observations, actions, mask).agent_rewards[:, -1]
    observations[:, 0] += 3
    assert not torch.allclose(model(observations, actions, mask).agent_rewards[:, -1], before)


def test_reward_without_a_temporal_encoder_is_markov(build):
    model = build(temporal="none")
    observations, actions, mask = draw(2, 6)
    before = model(observations, actions, mask).agent_rewards[:, -1]
    observations[:, :-1] += 3
    torch.testing.assert_close(model(observations, actions, mask).agent_rewards[:, -1], before, **CLOSE)


def test_reward_depends_on_the_other_agents(build):
    model = build()
    observations, actions, mask = draw(2, 6)
    before = model(observations, actions, mask).agent_rewards[:, :, 0]
    observations[:, :, 1] += 3
    assert not torch.allclose(model(observations, actions, mask).agent_rewards[:, :, 0], before)


@each_example
@given(st.integers(1, 8), st.integers(0, 99))
def test_swapping_segments_complements_the_probability(build, variant, n_steps, seed):
    score_0, score_1 = build(**variant)(*draw(2, n_steps, seed)).score
    preferred_0, preferred_1 = (score_0 - score_1).sigmoid(), (score_1 - score_0).sigmoid()
    torch.testing.assert_close(preferred_0 + preferred_1, torch.tensor(1.0))
    swapped_1, swapped_0 = build(**variant)(*(x.flip(0) for x in draw(2, n_steps, seed))).score
    torch.testing.assert_close((swapped_0 - swapped_1).sigmoid(), preferred_0, **CLOSE)


def test_untrained_network_equals_its_markov_path_with_equal_weights():
    torch.manual_seed(0)
    model = MAPT(RewardConfig(OBSERVATION_DIM, ACTION_DIM, N_AGENTS, hidden_dim=16))
    observations, actions, mask = draw(3, 5)
    output = model(observations, actions, mask)
    torch.testing.assert_close(output.agent_rewards, model.markov_rewards(observations, actions))
    torch.testing.assert_close(output.weights, torch.full((3, 5), 0.2))


def test_refitting_normalisers_keeps_outputs(build, variant):
    model = build(**variant)
    observations, actions, mask = draw(4, 6)
    before = model(observations, actions, mask).agent_rewards
    # Away from the clip, where the function cannot be kept.
    model.fit_normalisers(3 * observations + 2, 0.5 * actions - 1, mask, keep_function=True)
    after = model(observations, actions, mask).agent_rewards
    torch.testing.assert_close(after, before, rtol=1e-3, atol=1e-3)


def test_inputs_are_normalised_over_real_steps(build):
    model = build()
    observations, actions, mask = draw(4, 6)
    observations = 5 * observations + 3
    mask[:, 4:] = False
    observations[:, 4:] = 1e6
    model.fit_normalisers(observations, actions, mask, keep_function=False)
    normalised = model.observation_normaliser(observations)[mask].reshape(-1, OBSERVATION_DIM)
    torch.testing.assert_close(normalised.mean(dim=0), torch.zeros(OBSERVATION_DIM), **CLOSE)
    torch.testing.assert_close(normalised.std(dim=0, correction=0), torch.ones(OBSERVATION_DIM), **CLOSE)


def test_constant_input_is_not_scaled(build):
    model = build()
    observations, actions, mask = draw(4, 6)
    observations[..., 0] = 7.0
    model.fit_normalisers(observations, actions, mask, keep_function=False)
    assert model.observation_normaliser(observations)[..., 0].abs().max() == 0
    observations[..., 0] = 7.5
    assert model.observation_normaliser(observations)[..., 0].abs().max() == 0.5


def test_outlier_inputs_give_a_bounded_reward(build):
    model = build()
    observations, actions, mask = draw(1, 3)
    model.fit_normalisers(observations, actions, mask, keep_function=False)
    far, farther = (model(observations + shift, actions, mask).score for shift in (1e4, 1e8))
    torch.testing.assert_close(far, farther)


def test_inputs_with_other_dimensions_are_refused(build):
    model = build()
    observations, actions, mask = draw(2, 5)
    with pytest.raises(ShapeError):
        model(observations[..., 1:], actions, mask)
    with pytest.raises(ShapeError):
        model(observations[:, :, 1:], actions, mask)
    with pytest.raises(ShapeError):
        model(observations, actions[:, 1:], mask)
    with pytest.raises(ShapeError):
        model(observations, actions, mask[:, 1:])
