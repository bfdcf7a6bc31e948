"""Properties that hold for every model of the benchmark tables."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mapt.errors import InvalidConfig
from mapt.rewards.checkpoints import load_reward_model, save_reward_model
from mapt.rewards.config import MODEL_NAMES, RewardConfig
from mapt.rewards.model import PolicyReward, RewardModel
from mapt.rewards.registry import build_reward_model
from mapt.rewards.relabelling import RewardStream, RolloutRelabeller
from support.tolerance import assert_float32_close

pytestmark = pytest.mark.numerics


def assert_close(actual: torch.Tensor, expected: torch.Tensor, terms: torch.Tensor | None = None) -> None:
    assert_float32_close(actual.detach(), expected.detach(), terms=0.0 if terms is None else terms.detach())


N, C, A = 3, 4, 2
DIMENSIONS = {"observation_dim": C, "action_dim": A, "n_agents": N, "segment_steps": 5}
DEPENDS_ON_AGENT_ORDER = {"MA-Transformer"}
DEPENDS_ON_PAST = set(MODEL_NAMES) - {"MA-MLP"}
HAS_STEP_WEIGHTS = {"MAPT", "MAPT-paper", "MAPT-CPA", "MAPT*", "MAPT*-CPA", "MA-Transformer"}
each_example = settings(max_examples=8)
names = pytest.mark.parametrize("name", MODEL_NAMES)
lengths_of_segments = st.lists(st.integers(1, 7), min_size=1, max_size=3)


def config(name: str, **changes: object) -> RewardConfig:
    return replace(RewardConfig.named(name, **DIMENSIONS), hidden_dim=16, **changes)


def random_model(name: str, **changes: object) -> RewardModel:
    """A model in evaluation mode without zero-initialised layers."""
    model = build_reward_model(config(name, **changes)).eval()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.3)
    return model


def inputs(n_segments: int, n_steps: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shape = (n_segments, n_steps, N)
    return (
        torch.randn(*shape, C, generator=generator),
        torch.randn(*shape, A, generator=generator),
        torch.ones(n_segments, n_steps, dtype=torch.bool),
    )


def inputs_of_lengths(lengths: list[int], seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    observations, actions, _ = inputs(len(lengths), 7, seed)
    return observations, actions, torch.arange(7) < torch.tensor(lengths)[:, None]


def probability(model: RewardModel, *both: torch.Tensor) -> torch.Tensor:
    score_0, score_1 = model(*both).score
    return (score_0 - score_1).sigmoid()


@names
@each_example
@given(st.integers(1, 8), st.integers(0, 99))
def test_swapped_segments_have_the_complementary_probability(name, n_steps, seed):
    model, both = random_model(name), inputs(2, n_steps, seed)
    swapped = probability(model, *(tensor.flip(0) for tensor in both))
    assert_close(probability(model, *both) + swapped, torch.tensor(1.0))


@names
@each_example
@given(lengths_of_segments, st.integers(0, 99))
def test_padding_does_not_change_outputs(name, lengths, seed):
    model, (observations, actions, mask) = random_model(name), inputs_of_lengths(lengths, seed)
    output = model(observations, actions, mask)
    for i, length in enumerate(lengths):
        bare = model(*(tensor[i : i + 1, :length] for tensor in (observations, actions, mask)))
        assert_close(output.score[i], bare.score[0], output.agent_rewards)
        assert_close(output.weights[i, :length], bare.weights[0])
        assert_close(output.agent_rewards[i, :length], bare.agent_rewards[0], output.agent_rewards)


@names
@each_example
@given(lengths_of_segments, st.integers(0, 99))
def test_weights_of_real_steps_sum_to_one(name, lengths, seed):
    observations, actions, mask = inputs_of_lengths(lengths, seed)
    weights = random_model(name)(observations, actions, mask).weights
    assert (weights >= 0).all()
    assert (weights[~mask] == 0).all()
    assert_close(weights.sum(dim=1), torch.ones(len(lengths)))


@names
@each_example
@given(st.permutations(range(N)), st.integers(1, 8), st.integers(0, 99))
def test_permuting_agents_permutes_rewards(name, order, n_steps, seed):
    model, (observations, actions, mask) = random_model(name), inputs(2, n_steps, seed)
    rewards = model(observations, actions, mask).agent_rewards
    permuted = model(observations[:, :, order], actions[:, :, order], mask).agent_rewards
    if name in DEPENDS_ON_AGENT_ORDER:
        assert (rewards == rewards[:, :, :1]).all()
        assert order == list(range(N)) or not torch.allclose(permuted, rewards)
    else:
        assert_close(permuted, rewards[:, :, order])


@pytest.mark.parametrize("name", sorted(set(MODEL_NAMES) - HAS_STEP_WEIGHTS))
def test_score_without_step_weights_is_invariant_to_the_order_of_agents(name):
    model, (observations, actions, mask) = random_model(name), inputs(3, 5)
    permuted = model(observations.flip(2), actions.flip(2), mask).score
    assert_close(permuted, model(observations, actions, mask).score)


def test_step_weights_of_mapt_depend_on_the_order_of_agents():
    model, (observations, actions, mask) = random_model("MAPT"), inputs(3, 5)
    permuted = model(observations.flip(2), actions.flip(2), mask).weights
    assert not torch.allclose(permuted, model(observations, actions, mask).weights)


@names
def test_rewards_depend_on_the_past_if_the_model_encodes_it_and_never_on_the_future(name):
    model, (observations, actions, mask) = random_model(name), inputs(2, 6)
    before = model(observations, actions, mask).agent_rewards
    observations[:, 3] += 2
    after = model(observations, actions, mask).agent_rewards
    assert_close(after[:, :3], before[:, :3])
    assert not torch.allclose(after[:, 3], before[:, 3])
    assert torch.allclose(after[:, 4:], before[:, 4:]) == (name not in DEPENDS_ON_PAST)


@names
def test_weights_are_equal_without_preference_attention_over_steps(name):
    weights = random_model(name)(*inputs(2, 6)).weights
    assert torch.allclose(weights, torch.full((2, 6), 1 / 6)) == (name not in HAS_STEP_WEIGHTS)


@names
@each_example
@given(lengths_of_segments, st.integers(0, 99))
def test_policy_rewards_follow_their_equations(name, lengths, seed):
    model, (observations, actions, mask) = random_model(name), inputs_of_lengths(lengths, seed)
    output = model(observations, actions, mask)
    last = torch.arange(len(lengths)), torch.tensor(lengths) - 1
    value, weighted, attended = (
        model.policy_rewards(observations, actions, mask, kind) for kind in ("value", "weighted", "attended")
    )
    assert_close(value, output.agent_rewards[last], output.agent_rewards)
    times = torch.tensor(lengths) * output.weights[last]
    assert_close(weighted, times[:, None] * value, output.agent_rewards)
    low, high = ((output.agent_rewards * mask[..., None] + (~mask * far)[..., None]) for far in (1e9, -1e9))
    assert (attended >= low.amin(dim=1) - 1e-4).all()
    assert (attended <= high.amax(dim=1) + 1e-4).all()
    if name not in HAS_STEP_WEIGHTS:
        mean = (output.agent_rewards * mask[..., None]).sum(dim=1) / torch.tensor(lengths)[:, None]
        assert_close(attended, mean, output.agent_rewards)
        assert_close(weighted, value, output.agent_rewards)


@names
@each_example
@given(lengths_of_segments, st.integers(0, 99))
def test_score_is_the_weighted_mean_times_the_fraction_of_real_steps(name, lengths, seed):
    model, (observations, actions, mask) = random_model(name), inputs_of_lengths(lengths, seed)
    output = model(observations, actions, mask)
    mean = (output.weights * output.rewards).sum(dim=1)
    assert_close(output.score, mean * torch.tensor(lengths) / 5, output.agent_rewards)
    averaging = build_reward_model(replace(model.config, segment_steps=0)).eval()
    averaging.load_state_dict(model.state_dict())
    assert_close(averaging(observations, actions, mask).score, mean, output.agent_rewards)
    assert (model.config.score, averaging.config.score) == ("sum", "mean")


def test_short_segment_of_equal_rewards_scores_its_fraction_of_a_whole_one():
    model, (observations, actions, _) = random_model("MA-MLP"), inputs(1, 1)
    mask = torch.arange(5) < torch.tensor([5, 2])[:, None]
    whole, short = model(observations.expand(2, 5, -1, -1), actions.expand(2, 5, -1, -1), mask).score
    assert_close(short, 2 / 5 * whole)


@pytest.mark.parametrize("name", sorted(HAS_STEP_WEIGHTS))
def test_score_is_the_mean_of_attended_rewards(name):
    # Paper, eq. 6: the attended rewards of all queries average to the score.
    model, (observations, actions, mask) = random_model(name), inputs(1, 5)
    h, agent_rewards = model._encode(model._normalise_inputs(observations, actions), None)
    attended = model._step_attention(h, agent_rewards, mask) @ agent_rewards
    assert_close(attended.mean(dim=(1, 2)), model(observations, actions, mask).score)
    last = model.policy_rewards(observations, actions, mask, "attended")
    assert_close(last, attended[:, -1])


@names
@pytest.mark.parametrize("kind", get_args(PolicyReward))
def test_relabelled_rewards_are_those_of_each_window(name, kind):
    model, (observations, actions, _) = random_model(name), inputs(2, 9)
    start = torch.zeros(2, 9, dtype=torch.bool)
    start[:, 0] = start[1, 5] = True
    relabeller = RolloutRelabeller(model, window=4, n_envs=2, credit="individual", kind=kind)
    relabelled = relabeller.relabel(*(tensor.transpose(0, 1).numpy() for tensor in (observations, actions, start)))
    for env, step in ((0, 0), (0, 3), (0, 8), (1, 4), (1, 5), (1, 8)):
        first = max(step - 3, 5 if env == 1 and step >= 5 else 0)
        window = (tensor[env : env + 1, first : step + 1] for tensor in (observations, actions))
        own = model.policy_rewards(*window, torch.ones(1, step + 1 - first, dtype=torch.bool), kind)[0].detach()
        assert_close(torch.as_tensor(relabelled[step, env]), own)


@names
def test_zero_initialised_path_is_skipped_without_gradients(name, monkeypatch):
    """An untrained model gives the rewards of its Markov path without encoding the past."""
    torch.manual_seed(0)
    model = build_reward_model(config(name)).eval()
    assert model.is_markov == config(name).markov_path
    assert random_model(name).is_markov == (name == "MA-MLP")
    (observations, actions, _), start = inputs(2, 9), torch.zeros(2, 9, dtype=torch.bool)
    rollout = [tensor.transpose(0, 1).numpy() for tensor in (observations, actions, start)]
    own = model.agent_rewards(observations, actions).detach()
    if model.is_markov:
        monkeypatch.setattr(type(model), "_encode", None)
    relabelled = RolloutRelabeller(model, 9, 2, "individual").relabel(*rollout)
    stream = RewardStream(model, 9, 2, "individual")
    for rewards in (relabelled, np.stack([stream.step(*step) for step in zip(*rollout, strict=True)])):
        assert_close(torch.as_tensor(rewards).transpose(0, 1), own)


@names
def test_every_model_learns_a_preference(name):
    torch.manual_seed(0)
    model, (observations, actions, mask) = build_reward_model(config(name)), inputs(32, 5)
    better = (observations[..., 0].mean(dim=(1, 2)).reshape(2, 16).diff(dim=0)[0] < 0).float()
    optimiser = torch.optim.Adam(model.parameters(), 1e-2)
    for _ in range(40):
        first, second = model(observations, actions, mask).score.chunk(2)
        loss = torch.nn.functional.binary_cross_entropy_with_logits(first - second, better)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss.item() < 0.3


@names
def test_refitting_normalisers_keeps_outputs(name):
    model, (observations, actions, mask) = random_model(name), inputs(4, 6)
    before = model(observations, actions, mask).agent_rewards
    model.fit_normalisers(3 * observations + 2, 0.5 * actions - 1, mask, keep_function=True)
    assert_close(model(observations, actions, mask).agent_rewards, before)


@names
def test_scaling_rewards_keeps_the_weights_of_the_steps(name):
    model, given = random_model(name), inputs(4, 6)
    before = model(*given)
    model.scale_rewards(0.25)
    after = model(*given)
    assert_close(after.agent_rewards, 0.25 * before.agent_rewards)
    assert_close(after.weights, before.weights)
    assert_close(after.score, 0.25 * before.score)


@names
def test_rare_discrete_action_counts_as_much_as_an_observation(name):
    model, (observations, _, mask) = random_model(name, discrete_actions=True), inputs(40, 6)
    rare = torch.rand(40, 6, N, generator=torch.Generator().manual_seed(2)) < 0.05
    actions = torch.nn.functional.one_hot(rare.long(), A).float()
    model.fit_normalisers(observations, actions, mask, keep_function=False)
    normalised = model.action_normaliser(actions).reshape(-1, A)
    assert_close(normalised.std(dim=0, correction=0), torch.ones(A))
    # A version that continues from this one and sees the action more often keeps its rewards.
    before = model(observations, actions, mask).agent_rewards
    both = torch.cat((actions, actions.flip(-1)))
    model.fit_normalisers(observations.repeat(2, 1, 1, 1), both, mask.repeat(2, 1), keep_function=True)
    assert_close(model(observations, actions, mask).agent_rewards, before)


@names
def test_scores_and_weights_are_float32_under_autocast(name):
    model, (observations, actions, mask) = random_model(name), inputs(4, 6)
    exact = model(observations, actions, mask)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = model(observations, actions, mask)
    assert rounded.score.dtype == rounded.rewards.dtype == rounded.weights.dtype == torch.float32
    torch.testing.assert_close(rounded.weights.sum(dim=1), torch.ones(4), rtol=0, atol=1e-5)
    torch.testing.assert_close(rounded.score, exact.score, rtol=0.05, atol=0.05 * exact.rewards.std().item())


@names
def test_every_model_round_trips_through_storage(name):
    model = random_model(name)
    saved = save_reward_model(model, {})
    loaded = load_reward_model(saved.weights, saved.card).model
    assert type(loaded) is type(model)
    assert torch.equal(loaded(*inputs(2, 5)).score, model(*inputs(2, 5)).score)


@names
def test_markov_rewards_are_zero_without_a_markov_path(name):
    model, (observations, actions, _) = random_model(name), inputs(2, 5)
    markov = model.markov_rewards(observations, actions)
    assert markov.shape == (2, 5, N)
    assert (model.markov is None) == (markov == 0).all().item() == (name in {"MAPT-paper", "MA-LSTM", "MA-Transformer"})
    if name == "MA-MLP":
        assert_close(markov, model.agent_rewards(observations, actions))


@names
def test_shrink_and_perturb_changes_only_the_markov_path(name):
    model = build_reward_model(config(name))
    weights = model.state_dict()
    unchanged, reset = model.shrink_and_perturb(1.0), model.shrink_and_perturb(0.0)
    assert all(torch.equal(unchanged[key], weights[key]) for key in weights)
    changed = {key for key in weights if not torch.equal(reset[key], weights[key])}
    assert changed == {key for key in weights if key.startswith("markov.")}


@names
def test_new_head_replaces_the_rewards_of_the_markov_path(name):
    model = build_reward_model(config(name))
    weights, renewed = model.state_dict(), model.with_new_head()
    changed = {key.rpartition(".")[0] for key, tensor in renewed.items() if not torch.equal(tensor, weights[key])}
    heads = {"read_out.reward"} if name in DEPENDS_ON_PAST else set()
    assert changed == heads | ({"markov.reward"} if model.markov is not None else set())
    model.load_state_dict(renewed)
    assert not model.markov_rewards(*inputs(2, 5)[:2]).any()


@pytest.mark.parametrize("name", ["MA-LSTM", "MA-Transformer"])
def test_baselines_accept_a_markov_path(name):
    model = build_reward_model(config(name, markov_path=True))
    observations, actions, mask = inputs(2, 5)
    rewards = model(observations, actions, mask).agent_rewards
    assert_close(rewards, model.markov_rewards(observations, actions))


def test_model_names_have_the_order_of_the_tables():
    assert MODEL_NAMES == (
        "MAPT", "MAPT-paper", "MAPT-TPA", "MAPT-CPA", "MAPT*", "MAPT*-CPA", "MA-MLP", "MA-LSTM", "MA-Transformer"
    )  # fmt: skip


@names
def test_named_model_has_the_size_of_its_preset(name):
    paper = RewardConfig.named(name, "paper", discrete_actions=True, **DIMENSIONS)
    assert (paper.hidden_dim, paper.heads, paper.discrete_actions) == (256, 4, True)
    assert RewardConfig.from_dict(paper.to_dict()) == paper


def test_mapt_by_name_equals_the_small_preset():
    assert RewardConfig.named("MAPT", **DIMENSIONS) == RewardConfig.preset("small", **DIMENSIONS)


@pytest.mark.parametrize("preset", ["small", "paper"])
def test_the_network_of_the_paper_is_mapt_without_its_markov_path(preset):
    mapt, paper = (RewardConfig.named(name, preset, **DIMENSIONS) for name in ("MAPT", "MAPT-paper"))
    assert paper == replace(mapt, markov_path=False)
    assert paper.hidden_dim == {"small": 32, "paper": 256}[preset]


def test_unknown_name_is_refused():
    with pytest.raises(InvalidConfig):
        RewardConfig.named("MAPT+", **DIMENSIONS)


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"architecture": "gru"}, "architecture"),
        ({"architecture": "mlp"}, "temporal"),
        ({"architecture": "mlp", "temporal": "none", "markov_path": False}, "markov_path"),
        ({"architecture": "lstm", "temporal": "attention"}, "temporal"),
        ({"architecture": "transformer", "temporal": "lstm"}, "temporal"),
        ({"discrete_actions": 1}, "discrete_actions"),
    ],
)
def test_contradicting_settings_are_refused(settings, field):
    with pytest.raises(InvalidConfig) as error:
        RewardConfig(**DIMENSIONS, **settings)
    assert error.value.field == field
