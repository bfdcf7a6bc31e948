"""Models by name, with settings of their own."""

import pytest

from mapt.preferences.storage import SegmentLayout
from mapt.rewards.config import MODEL_NAMES
from mapt.rewards.errors import InvalidConfig
from mapt.rewards.train_config import TrainConfig
from mapt.studies.errors import InvalidStudy
from mapt.studies.naming import Written
from mapt.studies.variants import network_of, training_of

LAYOUT = SegmentLayout(n_steps=6, n_agents=2, observation_dim=3, action_dim=1)


def test_a_text_is_a_name_and_settings():
    written = Written.parse(" MAPT:tpa=false:hidden_dim=128:train.lr=1e-3:device=cpu ")
    assert written.name == "MAPT"
    assert written.settings == {"tpa": False, "hidden_dim": 128, "train.lr": 1e-3, "device": "cpu"}


@pytest.mark.parametrize("text", ["MAPT:", "MAPT:tpa", "MAPT:=1"])
def test_a_part_that_is_no_setting_is_refused(text):
    with pytest.raises(InvalidStudy, match="hidden_dim=128"):
        Written.parse(text)


@pytest.mark.parametrize("name", MODEL_NAMES)
def test_every_model_of_the_tables_has_the_dimensions_of_the_segments(name):
    config = network_of(name, "small", LAYOUT)
    assert (config.n_agents, config.observation_dim, config.action_dim) == (2, 3, 1)


def test_settings_go_to_the_network_or_to_its_training():
    text = "MAPT:hidden_dim=32:train.max_epochs=3"
    assert network_of(text, "small", LAYOUT).hidden_dim == 32
    training = training_of(text, "small", seed=5, device="cpu")
    assert (training.max_epochs, training.seed, training.device) == (3, 5, "cpu")
    assert training_of("MAPT", "paper", 5, "cpu").batch_pairs == TrainConfig.preset("paper").batch_pairs


@pytest.mark.parametrize("text", ["Nobody", "MAPT:colour=1", "MAPT:hidden_dim=7"])
def test_an_unknown_model_or_setting_is_refused(text):
    with pytest.raises(InvalidConfig):
        network_of(text, "small", LAYOUT)


def test_an_unknown_setting_of_the_training_is_refused():
    with pytest.raises(InvalidConfig):
        training_of("MAPT:train.colour=1", "small", 0, "cpu")
