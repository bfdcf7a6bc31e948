import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch

from mapt.errors import DamagedCheckpoint, InvalidConfig, ModelMismatch, NewerCheckpoint, NotEnoughPairs
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.rewards.config import MODEL_NAMES, RewardConfig, TrainConfig
from mapt.rewards.ensemble import (
    FORMAT,
    RewardEnsemble,
    load_reward_ensemble,
    save_reward_ensemble,
    train_reward_ensemble,
)
from mapt.rewards.model import RewardModel
from mapt.rewards.registry import build_reward_model
from support.tolerance import assert_float32_close

N, C, A, T = 3, 4, 2, 6
DIMENSIONS = {"observation_dim": C, "action_dim": A, "n_agents": N, "segment_steps": T}
QUICK = TrainConfig(markov_epochs=3, max_epochs=2, markov_lr=1e-2, device="cpu")
STORED = Path(__file__).parent / "stored" / "ensemble_format_1.safetensors"


def config(name: str = "MAPT", **settings: object) -> RewardConfig:
    return replace(RewardConfig.named(name, **DIMENSIONS), hidden_dim=16, **settings)


def segments(n_segments: int, seed: int = 0, shift: float = 0.0, shortest: int = 2) -> SegmentArrays:
    rng = np.random.default_rng(seed)
    observations = rng.standard_normal((n_segments, T, N, C), dtype=np.float32) + np.float32(shift)
    lengths = rng.integers(shortest, T + 1, n_segments)
    lengths[0] = T
    return SegmentArrays(
        observations,
        rng.standard_normal((n_segments, T, N, A), dtype=np.float32),
        np.arange(T) < lengths[:, None],
    )


def true_returns(arrays: SegmentArrays) -> np.ndarray:
    """The sum of the true rewards (S,) of each segment."""
    reward = np.tanh(arrays.observations[..., 0] + arrays.actions[..., 0]).mean(axis=2)
    return (reward * arrays.mask).sum(axis=1)


def preferences(n_pairs: int = 60, seed: int = 0) -> PreferenceDataset:
    arrays = segments(2 * n_pairs, seed)
    pairs = np.arange(2 * n_pairs).reshape(-1, 2)
    true = true_returns(arrays)
    return PreferenceDataset(arrays, pairs, (true[pairs[:, 0]] > true[pairs[:, 1]]).astype(np.float32))


def random_models(members: int, settings: RewardConfig) -> list[RewardModel]:
    """Models without zero-initialised layers."""
    models = [build_reward_model(settings) for _ in range(members)]
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for model in models:
            for parameter in model.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.3)
    return models


def same_weights(first: RewardEnsemble, second: RewardEnsemble) -> bool:
    return all(
        torch.equal(tensor, other.state_dict()[name])
        for one, other in zip(first.members, second.members, strict=True)
        for name, tensor in one.state_dict().items()
    )


@pytest.mark.parametrize("name", MODEL_NAMES)
def test_scores_are_those_of_each_member(name):
    models = [model.eval() for model in random_models(3, config(name))]
    arrays = segments(9)
    scores = RewardEnsemble(models).scores(arrays)
    assert (scores.shape, scores.dtype) == ((3, 9), np.float32)
    inputs = [torch.as_tensor(array) for array in (arrays.observations, arrays.actions, arrays.mask)]
    for row, model in zip(scores, models, strict=True):
        assert_float32_close(row, model(*inputs).score.detach())


@pytest.mark.parametrize("name", ["MAPT", "MA-MLP"])
def test_members_learn(name):
    longer = replace(QUICK, markov_epochs=5, max_epochs=8, patience=8, lr=3e-3, batch_pairs=16)
    ensemble = train_reward_ensemble(preferences(80), config(name), longer, 2)
    assert ensemble.metrics["accuracy"] > 0.75
    assert ensemble.metrics["ensemble_holdout_accuracy"] > 0.6
    assert len(ensemble) == ensemble.metrics["members"] == 2
    assert ensemble.metrics["labels"] == 80
    assert 10 <= ensemble.metrics["holdout_labels"] <= 24


def test_same_seed_gives_the_same_ensemble():
    first, second, other = (
        train_reward_ensemble(preferences(), config(), replace(QUICK, seed=seed), 2) for seed in (0, 0, 1)
    )
    assert same_weights(first, second)
    assert not same_weights(first, other)


@pytest.mark.slow
def test_training_in_processes_gives_the_same_ensemble():
    epochs = []
    networks, settings = config("MA-MLP"), replace(QUICK, markov_epochs=2, smoothness_factor=1.0)
    in_process = train_reward_ensemble(preferences(), networks, settings, 2)
    in_workers = train_reward_ensemble(preferences(), networks, settings, 2, workers=2, progress=epochs.append)
    for one, other in zip(in_process.members, in_workers.members, strict=True):
        torch.testing.assert_close(dict(one.state_dict()), dict(other.state_dict()), rtol=1e-4, atol=1e-5)
    assert [at.epoch for at in epochs] == [1, 2, 3, 4]


@pytest.mark.slow
def test_stop_ends_training_in_processes():
    endless = replace(QUICK, markov_epochs=10**6, markov_patience=10**6, markov_visits=10**9)
    epochs = []
    ensemble = train_reward_ensemble(
        preferences(),
        config("MA-MLP"),
        endless,
        3,
        workers=2,
        progress=epochs.append,
        stop=lambda: len(epochs) >= 3,
    )
    assert ensemble.metrics["stopped"] == 1
    assert len(ensemble) == 3


PARENT = """
import sys
sys.path[:0] = {folders!r}
from test_ensemble import QUICK, config, preferences
from dataclasses import replace
from mapt.rewards.ensemble import train_reward_ensemble
if __name__ == "__main__":
    endless = replace(QUICK, markov_epochs=10**6, markov_patience=10**6, markov_visits=10**9)
    report = lambda at: print(at.epoch, flush=True)
    train_reward_ensemble(preferences(), config("MA-MLP"), endless, 2, workers=2, progress=report)
"""


@pytest.mark.slow
def test_worker_processes_end_when_their_parent_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    folder = Path(__file__).parent
    script.write_text(PARENT.format(folders=[str(folder), str(folder.parents[1])]))
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    assert parent.stdout.readline().strip() == "1"
    children = psutil.Process(parent.pid).children(recursive=True)
    assert len(children) >= 2
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 60
    while any(child.is_running() and child.status() != psutil.STATUS_ZOMBIE for child in children):
        assert time.monotonic() < deadline, "worker processes outlive their parent"
        time.sleep(0.05)


def test_training_keeps_the_global_random_state():
    before = torch.random.get_rng_state()
    train_reward_ensemble(preferences(), config(), QUICK, 2)
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.slow
def test_members_disagree_more_on_segments_unlike_the_labelled_ones():
    ensemble = train_reward_ensemble(preferences(200), config("MA-MLP"), replace(QUICK, markov_epochs=20), 5)
    similar, shifted = (
        ensemble.scores(segments(200, seed=5, shift=shift, shortest=T)).astype(np.float64) for shift in (0.0, 4.0)
    )
    spread = [(1 / (1 + np.exp(scores[:, 1::2] - scores[:, ::2]))).std(axis=0).mean() for scores in (similar, shifted)]
    assert 0 < spread[0] < spread[1]


def test_members_differ():
    ensemble = train_reward_ensemble(preferences(), config("MA-MLP"), QUICK, 2)
    assert not same_weights(RewardEnsemble(ensemble.members[:1]), RewardEnsemble(ensemble.members[1:]))


def test_ensemble_of_one_member_gives_one_row_of_scores():
    ensemble = train_reward_ensemble(preferences(), config(), QUICK, 1)
    assert len(ensemble) == 1
    assert ensemble.scores(segments(5)).shape == (1, 5)


def test_training_continues_from_an_ensemble_without_changing_it():
    first = train_reward_ensemble(preferences(40), config(), QUICK, 2)
    stored = save_reward_ensemble(first)
    second = train_reward_ensemble(preferences(60), config(), QUICK, 2, initial=first)
    assert save_reward_ensemble(first) == stored
    assert not same_weights(first, second)
    with pytest.raises(ModelMismatch):
        train_reward_ensemble(preferences(), config(), QUICK, 3, initial=first)
    with pytest.raises(ModelMismatch):
        train_reward_ensemble(preferences(), config(tpa=False), QUICK, 2, initial=first)


def test_rewards_of_each_member_are_normalised_over_the_reference():
    arrays = segments(50, seed=9)
    for member in train_reward_ensemble(preferences(), config(), QUICK, 2, reference=arrays).members:
        with torch.no_grad():
            rewards = member.agent_rewards(torch.as_tensor(arrays.observations), torch.as_tensor(arrays.actions))
        normalised = member.normalised(rewards.mean(dim=2))[torch.as_tensor(arrays.mask)]
        assert normalised.mean().item() == pytest.approx(0, abs=1e-3)
        assert normalised.std(correction=0).item() == pytest.approx(1, abs=1e-3)


def test_progress_counts_epochs_over_members_and_stop_ends_all():
    epochs = []
    ensemble = train_reward_ensemble(
        preferences(), config(), QUICK, 2, progress=epochs.append, stop=lambda: len(epochs) >= 7
    )
    assert [progress.epoch for progress in epochs] == [1, 2, 3, 4, 5, 6, 7]
    assert 0 < epochs[0].holdout_loss < 2
    assert ensemble.metrics["stopped"] == 1
    assert ensemble.metrics["epochs"] == 7


def test_metrics_undefined_for_ties_are_left_out():
    arrays = preferences(20)
    tied = PreferenceDataset(arrays.segments, arrays.pairs, np.full(20, 0.5, dtype=np.float32))
    metrics = train_reward_ensemble(tied, config(), QUICK, 2).metrics
    assert not {"accuracy", "ensemble_holdout_accuracy"} & set(metrics)
    assert metrics["holdout_reliable"] == 0


def test_invalid_arguments_are_refused():
    with pytest.raises(InvalidConfig):
        train_reward_ensemble(preferences(), config(), QUICK, 0)
    with pytest.raises(InvalidConfig):
        train_reward_ensemble(preferences(), config(), QUICK, 2, workers=0)
    with pytest.raises(NotEnoughPairs):
        train_reward_ensemble(preferences(20).take([0]), config(), QUICK, 2)
    with pytest.raises(ModelMismatch):
        train_reward_ensemble(preferences(), replace(config(), n_agents=5), QUICK, 2)
    with pytest.raises(InvalidConfig):
        RewardEnsemble([])
    with pytest.raises(ModelMismatch):
        RewardEnsemble([build_reward_model(config()), build_reward_model(config(tpa=False))])


def test_segments_with_other_dimensions_are_refused():
    ensemble, arrays = RewardEnsemble(random_models(2, config())), segments(4)
    narrow = SegmentArrays(arrays.observations[..., 1:], arrays.actions, arrays.mask)
    with pytest.raises(ModelMismatch):
        ensemble.scores(narrow)


@pytest.mark.parametrize("name", ["MAPT", "MAPT*", "MA-Transformer"])
def test_storage_round_trip_gives_the_same_bits(name, tmp_path):
    ensemble = RewardEnsemble(random_models(2, config(name)), {"holdout_loss": 0.5})
    stored = save_reward_ensemble(ensemble)
    (tmp_path / "ensemble.safetensors").write_bytes(stored)
    for source in (stored, tmp_path / "ensemble.safetensors"):
        loaded = load_reward_ensemble(source)
        assert same_weights(ensemble, loaded)
        assert (loaded.config, loaded.metrics) == (ensemble.config, {"holdout_loss": 0.5})
        assert save_reward_ensemble(loaded) == stored


def test_file_written_by_the_vectorised_ensemble_loads():
    """Written by version 0.4, whose members were trained in one vectorised pass."""
    observations = np.arange(48, dtype=np.float32).reshape(2, 4, 2, 3) / 48
    actions = np.arange(32, dtype=np.float32).reshape(2, 4, 2, 2) / -32
    ensemble = load_reward_ensemble(STORED)
    scores = ensemble.scores(SegmentArrays(observations, actions, np.ones((2, 4), dtype=np.bool_)))
    expected = [[23.322193145751953, 25.376190185546875], [-39.703285217285156, -37.58301544189453]]
    np.testing.assert_allclose(scores, expected, rtol=1e-5)
    assert [model.reward_deviation.item() for model in ensemble.members] == [1.0, 2.0]
    assert ensemble.metrics == {"holdout_loss": 0.5}
    assert ensemble.config.score == "mean"


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
def test_altered_card_is_refused(changes):
    stored = save_reward_ensemble(RewardEnsemble(random_models(2, config())))
    assert load_reward_ensemble(with_card(stored)).config == config()
    with pytest.raises(DamagedCheckpoint):
        load_reward_ensemble(with_card(stored, **changes))


def test_newer_format_is_refused():
    stored = save_reward_ensemble(RewardEnsemble(random_models(2, config())))
    with pytest.raises(NewerCheckpoint):
        load_reward_ensemble(with_card(stored, format_version=3))


@pytest.mark.parametrize(
    "damage", [lambda b: b"", lambda b: b[:5], lambda b: b[:-1], lambda b: b[:-1] + bytes([b[-1] ^ 1])]
)
def test_incomplete_or_altered_file_is_refused(damage):
    stored = save_reward_ensemble(RewardEnsemble(random_models(2, config())))
    with pytest.raises(DamagedCheckpoint):
        load_reward_ensemble(damage(stored))


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(DamagedCheckpoint):
        load_reward_ensemble(tmp_path / "missing.safetensors")


def test_file_names_its_format():
    assert FORMAT.encode() in save_reward_ensemble(RewardEnsemble(random_models(1, config())))[:4096]
