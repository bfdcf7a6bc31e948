import pytest
import torch

from mapt.rewards.config import RewardConfig, TrainConfig
from mapt.rewards.schedule import (
    Schedule,
    StageSettings,
    is_accepted,
    is_out_of_patience,
    is_significant,
    plan_schedule,
)

DIMENSIONS = {"observation_dim": 4, "action_dim": 2, "n_agents": 3, "segment_steps": 8}


def schedule(name: str, *, warm: bool = False, reliable: bool = True, **training: int) -> Schedule:
    network = RewardConfig.named(name, **DIMENSIONS)
    return plan_schedule(TrainConfig(**training), network, 100, warm=warm, reliable=reliable)


@pytest.mark.parametrize("name", ["MAPT*", "MAPT*-CPA"])
def test_network_stage_of_an_lstm_restarts_unless_warm(name):
    assert schedule(name).network.restart
    assert not schedule(name, warm=True).network.restart
    assert schedule(name, markov_epochs=0).network.restart


@pytest.mark.parametrize("name", ["MAPT", "MAPT-TPA", "MA-LSTM"])
def test_network_stage_of_other_models_continues(name):
    assert not schedule(name).network.restart


def test_network_stage_must_improve_on_a_markov_path():
    assert schedule("MAPT").network.must_improve
    assert not schedule("MA-LSTM").network.must_improve


@pytest.mark.parametrize(("name", "reliable"), [("MA-MLP", True), ("MAPT", False)])
def test_only_the_markov_path_is_trained_without_another_path_or_a_reliable_hold_out(name, reliable):
    planned = schedule(name, reliable=reliable)
    assert planned.markov is not None
    assert planned.network is None


def test_constant_gain_is_significant_and_a_single_outlier_is_not():
    assert is_significant(torch.tensor([0.2, 0.1, 0.3, 0.2]))
    assert not is_significant(torch.tensor([1.0, -0.5, 0.1, -0.1, 0.0, 0.0, 0.0, 0.0]))
    assert not is_significant(torch.tensor([-0.2, -0.1, -0.3]))


def test_zero_gain_is_not_significant():
    assert not is_significant(torch.zeros(20))


@pytest.mark.parametrize(
    ("before", "after", "accepted"),
    [(0.1, 0.05, True), (0.1, 0.2, True), (0.1, 0.69, True), (0.1, 0.8, False), (0.9, 0.85, True)],
)
def test_result_that_need_not_improve_is_accepted_up_to_the_loss_of_chance(before, after, accepted):
    settings = StageSettings(1e-3, 0.0, 32, 1, 1, 0.0)
    assert is_accepted(settings, torch.full((20,), before), torch.full((20,), after)) == accepted


@pytest.mark.parametrize(
    ("waited", "above_chance", "ends"),
    [(4, True, False), (5, True, True), (5, False, False), (19, False, False), (20, False, True)],
)
def test_patience_is_longer_until_accuracy_is_above_chance(waited, above_chance, ends):
    settings = StageSettings(1e-3, 0.0, 32, 60, patience=5, label_noise=0.0, patience_at_chance=20)
    assert is_out_of_patience(settings, waited, above_chance) == ends
