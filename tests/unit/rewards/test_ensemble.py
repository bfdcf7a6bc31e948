import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from mapt.errors import DamagedCheckpoint, InvalidConfig, ModelMismatch, NewerCheckpoint, NotEnoughPairs
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.preferences.loss import preference_loss
from mapt.rewards.config import MODEL_NAMES, RewardConfig, TrainConfig
from mapt.rewards.data import PairTensors, segment_reader
from mapt.rewards.ensemble import RewardEnsemble, train_reward_ensemble
from mapt.rewards.ensemble_fitting import ensemble_step
from mapt.rewards.ensemble_scorers import whole_stack_scorer
from mapt.rewards.ensemble_storage import FORMAT, load_reward_ensemble, save_reward_ensemble
from mapt.rewards.model import RewardModel
from mapt.rewards.registry import build_reward_model
from mapt.rewards.schedule import StageSettings
from mapt.rewards.stacked import StackedModels
from mapt.rewards.trainer import GRADIENT_NORM_LIMIT, adamw

N, C, A, T = 3, 4, 2, 6
DIMENSIONS = {"observation_dim": C, "action_dim": A, "n_agents": N}
CLOSE = {"rtol": 1e-5, "atol": 1e-5}
QUICK = TrainConfig(markov_epochs=3, max_epochs=2, markov_lr=1e-2, device="cpu")


def config(name: str = "MAPT", **settings: object) -> RewardConfig:
    return replace(RewardConfig.named(name, **DIMENSIONS), hidden_dim=16, **settings)


def segments(n_segments: int, seed: int = 0, shift: float = 0.0) -> SegmentArrays:
    rng = np.random.default_rng(seed)
    observations = rng.standard_normal((n_segments, T, N, C), dtype=np.float32) + np.float32(shift)
    lengths = rng.integers(2, T + 1, n_segments)
    lengths[0] = T
    return SegmentArrays(
        observations,
        rng.standard_normal((n_segments, T, N, A), dtype=np.float32),
        np.arange(T) < lengths[:, None],
    )


def returns(of: SegmentArrays) -> np.ndarray:
    reward = np.tanh(of.observations[..., 0] + of.actions[..., 0]).mean(axis=2)
    return (reward * of.mask).sum(axis=1) / of.mask.sum(axis=1)


def preferences(n_pairs: int = 60, seed: int = 0) -> PreferenceDataset:
    both = segments(2 * n_pairs, seed)
    pairs = np.arange(2 * n_pairs).reshape(-1, 2)
    true = returns(both)
    return PreferenceDataset(both, pairs, (true[pairs[:, 0]] > true[pairs[:, 1]]).astype(np.float32))


def drawn_models(members: int, settings: RewardConfig) -> list[RewardModel]:
    """Models whose every parameter was drawn, so that no branch is silent."""
    models = [build_reward_model(settings) for _ in range(members)]
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for model in models:
            for parameter in model.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.3)
    return models


def same_state(first: RewardEnsemble, second: RewardEnsemble) -> bool:
    return all(torch.equal(tensor, second.state()[name]) for name, tensor in first.state().items())


@pytest.mark.parametrize("name", MODEL_NAMES)
def test_members_score_as_the_models_they_are(name):
    models = [model.eval() for model in drawn_models(3, config(name))]
    ensemble, seen = RewardEnsemble.of(models), segments(9)
    inputs = [torch.as_tensor(array) for array in (seen.observations, seen.actions, seen.mask)]
    scores = torch.as_tensor(ensemble.scores(seen))
    assert scores.shape == (3, 9)
    assert scores.dtype == torch.float32
    for i, model in enumerate(models):
        torch.testing.assert_close(scores[i], model(*inputs).score.detach(), **CLOSE)
        torch.testing.assert_close(scores[i], ensemble.member(i)(*inputs).score.detach(), **CLOSE)


def separate_step(model: RewardModel, dataset: PreferenceDataset, index: torch.Tensor) -> float:
    """One step of one model, as a reader would write it."""
    scores = []
    for side in (0, 1):
        part = dataset.segments.take(dataset.pairs[index, side])
        scores.append(model(*(torch.as_tensor(a) for a in (part.observations, part.actions, part.mask))).score)
    loss = preference_loss(scores[0], scores[1], torch.as_tensor(dataset.labels)[index])
    loss.backward()
    nn.utils.clip_grad_norm_(model.parameters(), GRADIENT_NORM_LIMIT)
    torch.optim.SGD(model.parameters(), 0.1).step()
    return loss.item()


@pytest.mark.parametrize("name", MODEL_NAMES)
def test_a_vectorised_step_is_as_many_steps_apart(name):
    dataset = preferences(20)
    models = drawn_models(3, config(name, dropout=0.0))
    stack = StackedModels(models)
    # Adam's first step blows the rounding of gradients that are zero up to the step's size: no way to compare.
    optimiser = torch.optim.SGD(stack.parameters.values(), 0.1)
    known = PairTensors.of(dataset, torch.device("cpu"))
    index = torch.stack([torch.randperm(20, generator=torch.Generator().manual_seed(i))[:8] for i in range(3)])
    before = {name: tensor.clone() for name, tensor in stack.state().items()}
    loss = ensemble_step(
        known, whole_stack_scorer(stack, segment_reader(dataset.segments, torch.device("cpu"))), optimiser, index
    )
    losses = [separate_step(model, dataset, rows) for model, rows in zip(models, index, strict=True)]
    assert loss.item() == pytest.approx(sum(losses) / 3, rel=1e-5)
    for i, model in enumerate(models):
        own = stack.state_of(i)
        assert sum((own[key] - before[key][i]).square().sum() for key in own) > 1e-4
        for key, value in model.state_dict().items():
            torch.testing.assert_close(own[key], value, **CLOSE, msg=f"{key} of member {i}")


def test_a_step_that_expects_mistakes_counts_them_as_such():
    dataset = preferences(20)
    models = drawn_models(2, config("MA-MLP"))
    scores = torch.as_tensor(RewardEnsemble.of(models).scores(dataset.segments))
    stack = StackedModels(models)
    known = PairTensors.of(dataset, torch.device("cpu"))
    scorer = whole_stack_scorer(stack, segment_reader(dataset.segments, torch.device("cpu")))
    still = torch.optim.SGD(stack.parameters.values(), 0.0)
    index = torch.arange(20).expand(2, 20)
    for noise in (0.0, 0.3):
        apart = [preference_loss(own[::2], own[1::2], known.labels, noise).item() for own in scores]
        assert ensemble_step(known, scorer, still, index, noise).item() == pytest.approx(np.mean(apart), rel=1e-5)


def test_the_optimiser_of_a_stack_shrinks_matrices_alone():
    settings = StageSettings(lr=0.1, weight_decay=0.5, batch_pairs=1, max_epochs=1, patience=1, label_noise=0.0)
    stack = StackedModels(drawn_models(2, config()))
    for parameter in stack.parameters.values():
        parameter.grad = torch.zeros_like(parameter)
    before = {name: parameter.detach().clone() for name, parameter in stack.parameters.items()}
    adamw(stack.parameters.values(), settings, matrix_dims=3).step()
    for name, parameter in build_reward_model(config()).named_parameters():
        shrunk = 0.95 if parameter.dim() == 2 else 1.0
        torch.testing.assert_close(stack.parameters[name].detach(), shrunk * before[name])


@pytest.mark.parametrize("name", ["MAPT", "MAPT*-CPA", "MA-MLP", "MA-LSTM", "MA-Transformer"])
def test_models_learn_as_an_ensemble(name):
    longer = replace(QUICK, markov_epochs=5, max_epochs=8, patience=8, lr=3e-3, batch_pairs=16)
    ensemble = train_reward_ensemble(preferences(80), config(name), longer, 2)
    assert ensemble.metrics["accuracy"] > 0.75
    assert len(ensemble) == ensemble.metrics["members"] == 2


@pytest.mark.parametrize("resampled", [False, True])
def test_the_same_seed_gives_the_same_ensemble_and_another_seed_another(resampled):
    first, second, other = (
        train_reward_ensemble(preferences(), config(), replace(QUICK, seed=seed), 2, resampled=resampled)
        for seed in (0, 0, 1)
    )
    assert same_state(first, second)
    assert not same_state(first, other)


def test_training_leaves_the_global_generator_as_it_was():
    before = torch.random.get_rng_state()
    train_reward_ensemble(preferences(), config(), QUICK, 2)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_members_differ_and_agree_where_labels_settle_the_matter():
    ensemble = train_reward_ensemble(preferences(200), config("MA-MLP"), replace(QUICK, markov_epochs=20), 5)
    known, strange = ensemble.scores(segments(200, seed=5)), ensemble.scores(segments(200, seed=5, shift=4.0))
    spread = [(1 / (1 + np.exp(scores[:, ::2] - scores[:, 1::2]))).std(axis=0).mean() for scores in (known, strange)]
    assert 0 < spread[0] < spread[1]


def test_an_ensemble_of_one_is_a_model():
    ensemble = train_reward_ensemble(preferences(), config(), QUICK, 1)
    assert len(ensemble) == 1
    assert ensemble.scores(segments(5)).shape == (1, 5)
    assert ensemble.member(-1).config == config()
    with pytest.raises(IndexError):
        ensemble.member(1)


def test_each_member_keeps_the_weights_that_judged_best_for_it():
    dataset, wild = preferences(60), replace(QUICK, lr=1.0, markov_lr=1.0)
    before = train_reward_ensemble(dataset, config(), replace(QUICK, markov_epochs=20), 3)
    after = train_reward_ensemble(dataset, config(), wild, 3, initial=before)
    # Steps this large only do harm, and harm is not kept.
    assert after.metrics["holdout_loss"] <= before.metrics["holdout_loss"] + 1e-6


def test_a_training_goes_on_from_another_which_is_left_as_it_is():
    first = train_reward_ensemble(preferences(40), config(), QUICK, 2)
    stored = save_reward_ensemble(first)
    second = train_reward_ensemble(preferences(60), config(), QUICK, 2, initial=first)
    assert save_reward_ensemble(first) == stored
    assert not same_state(first, second)
    with pytest.raises(ModelMismatch, match="members"):
        train_reward_ensemble(preferences(), config(), QUICK, 3, initial=first)
    with pytest.raises(ModelMismatch, match="settings"):
        train_reward_ensemble(preferences(), config(tpa=False), QUICK, 2, initial=first)


def test_rewards_of_every_member_are_normalised_over_the_reference():
    seen = segments(50, seed=9)
    ensemble = train_reward_ensemble(preferences(), config(), QUICK, 2, reference=seen)
    for i in range(2):
        member = ensemble.member(i)
        rewards = member.agent_rewards(torch.as_tensor(seen.observations), torch.as_tensor(seen.actions)).mean(dim=2)
        normalised = member.normalised(rewards)[torch.as_tensor(seen.mask)]
        assert normalised.mean().item() == pytest.approx(0, abs=1e-4)
        assert normalised.std(correction=0).item() == pytest.approx(1, abs=1e-3)


def test_progress_is_told_and_a_stop_is_heard():
    epochs = []
    ensemble = train_reward_ensemble(
        preferences(), config(), QUICK, 2, progress=epochs.append, stop=lambda: len(epochs) >= 2
    )
    assert [progress.epoch for progress in epochs] == [1, 2]
    assert epochs[0].max_epochs == 5
    assert 0 < epochs[0].holdout_loss < 2
    assert ensemble.metrics["stopped"] == 1


def test_ties_alone_leave_out_what_cannot_be_measured():
    both = preferences(20)
    tied = PreferenceDataset(both.segments, both.pairs, np.full(20, 0.5, dtype=np.float32))
    metrics = train_reward_ensemble(tied, config(), QUICK, 2).metrics
    assert "accuracy" not in metrics
    assert metrics["holdout_reliable"] == 0


def test_what_cannot_be_trained_is_refused():
    with pytest.raises(InvalidConfig, match="members"):
        train_reward_ensemble(preferences(), config(), QUICK, 0)
    with pytest.raises(NotEnoughPairs):
        train_reward_ensemble(preferences(20).take([0]), config(), QUICK, 2)
    with pytest.raises(ModelMismatch, match="agents"):
        train_reward_ensemble(preferences(), replace(config(), n_agents=5), QUICK, 2)
    with pytest.raises(InvalidConfig, match="at least one"):
        RewardEnsemble.of([])
    with pytest.raises(ModelMismatch, match="settings"):
        RewardEnsemble.of([build_reward_model(config()), build_reward_model(config(tpa=False))])


def test_segments_of_another_task_are_not_scored():
    ensemble, seen = RewardEnsemble.of(drawn_models(2, config())), segments(4)
    narrow = SegmentArrays(seen.observations[..., 1:], seen.actions, seen.mask)
    with pytest.raises(ModelMismatch, match="observation"):
        ensemble.scores(narrow)


@pytest.mark.parametrize("name", ["MAPT", "MAPT*", "MA-Transformer"])
def test_an_ensemble_survives_storage_bit_by_bit(name, tmp_path):
    ensemble = RewardEnsemble.of(drawn_models(2, config(name)), {"holdout_loss": 0.5})
    stored = save_reward_ensemble(ensemble)
    (tmp_path / "ensemble.safetensors").write_bytes(stored)
    for source in (stored, tmp_path / "ensemble.safetensors"):
        loaded = load_reward_ensemble(source)
        assert same_state(ensemble, loaded)
        assert (loaded.config, loaded.metrics) == (ensemble.config, {"holdout_loss": 0.5})
        assert save_reward_ensemble(loaded) == stored


def with_card(stored: bytes, **changes: object) -> bytes:
    length = int.from_bytes(stored[:8], "little")
    header = json.loads(stored[8 : 8 + length])
    card = {**json.loads(header["__metadata__"]["card"]), **changes}
    written = json.dumps({**header, "__metadata__": {"card": json.dumps(card)}}).encode()
    return len(written).to_bytes(8, "little") + written + stored[8 + length :]


@pytest.mark.parametrize(
    "changes",
    [
        {"format": "something else"},
        {"format_version": 0},
        {"config": None},
        {"config": {"observation_dim": 4}},
        {"config": config("MA-MLP").to_dict()},
        {"metrics": None},
        {"metrics": {"loss": "low"}},
        {"weights_sha256": "0" * 64},
    ],
)
def test_an_ensemble_with_an_altered_card_is_refused(changes):
    stored = save_reward_ensemble(RewardEnsemble.of(drawn_models(2, config())))
    assert load_reward_ensemble(with_card(stored)).config == config()
    with pytest.raises(DamagedCheckpoint):
        load_reward_ensemble(with_card(stored, **changes))


def test_an_ensemble_of_a_later_version_asks_for_an_update():
    stored = save_reward_ensemble(RewardEnsemble.of(drawn_models(2, config())))
    with pytest.raises(NewerCheckpoint):
        load_reward_ensemble(with_card(stored, format_version=2))


@pytest.mark.parametrize(
    "damage", [lambda b: b"", lambda b: b[:5], lambda b: b[:-1], lambda b: b[:-1] + bytes([b[-1] ^ 1])]
)
def test_an_ensemble_that_is_not_whole_is_refused(damage):
    stored = save_reward_ensemble(RewardEnsemble.of(drawn_models(2, config())))
    with pytest.raises(DamagedCheckpoint):
        load_reward_ensemble(damage(stored))


def test_a_missing_ensemble_is_named(tmp_path):
    with pytest.raises(DamagedCheckpoint, match=r"gone\.safetensors"):
        load_reward_ensemble(tmp_path / "gone.safetensors")


def test_the_format_is_named_in_the_file():
    assert FORMAT.encode() in save_reward_ensemble(RewardEnsemble.of(drawn_models(1, config())))[:4096]


def test_an_ensemble_learns_in_bfloat16_what_it_learns_in_float32():
    network, settings = config(markov_path=False), TrainConfig(max_epochs=6, device="cpu")
    exact, rough = (
        train_reward_ensemble(preferences(80), network, replace(settings, precision=precision), 2).metrics["loss"]
        for precision in ("float32", "bfloat16")
    )
    assert rough != exact
    assert rough == pytest.approx(exact, rel=0.2)
