import pytest

from mapt.rewards.config import RewardConfig, TrainConfig
from mapt.rewards.schedule import Stages, plan_stages

DIMENSIONS = {"observation_dim": 4, "action_dim": 2, "n_agents": 3}


def stages(name: str, *, warm: bool = False, reliable: bool = True, **training: int) -> Stages:
    network = RewardConfig.named(name, **DIMENSIONS)
    return plan_stages(TrainConfig(**training), network, 100, warm=warm, reliable=reliable)


@pytest.mark.parametrize("name", ["MAPT*", "MAPT*-CPA"])
def test_an_lstm_beside_a_markov_path_begins_anew_once(name):
    assert stages(name).whole.anew
    assert not stages(name, warm=True).whole.anew
    assert stages(name, markov_epochs=0).whole.anew, "the path it stands beside is there anyhow"


@pytest.mark.parametrize("name", ["MAPT", "MAPT-TPA", "MA-LSTM"])
def test_others_go_on_from_what_there_is(name):
    assert not stages(name).whole.anew


def test_a_path_that_can_fall_back_to_a_markov_path_must_convince():
    assert stages("MAPT").whole.must_convince
    assert not stages("MA-LSTM").whole.must_convince


@pytest.mark.parametrize(("name", "reliable"), [("MA-MLP", True), ("MAPT", False)])
def test_a_markov_path_alone_is_trained_where_nothing_else_is_or_can_be_judged(name, reliable):
    planned = stages(name, reliable=reliable)
    assert planned.markov is not None
    assert planned.whole is None
