import pytest

from mapt.errors import InvalidConfig
from mapt.rewards.config import RewardConfig, TrainConfig

DIMENSIONS = {"observation_dim": 9, "action_dim": 1, "n_agents": 6}


def test_presets_have_their_sizes():
    paper = RewardConfig.preset("paper", **DIMENSIONS, segment_steps=50)
    assert (paper.hidden_dim, paper.layers, paper.heads, paper.dropout) == (256, 1, 4, 0.1)
    assert (TrainConfig.preset("paper").lr, TrainConfig.preset("paper").batch_pairs) == (1e-4, 256)
    small = RewardConfig.preset("small", **DIMENSIONS, segment_steps=50)
    assert (small.hidden_dim, small.markov_dim) == (32, 64)
    assert (small.observation_dim, small.action_dim, small.n_agents) == (9, 1, 6)


@pytest.mark.parametrize("config", [RewardConfig(**DIMENSIONS, layers=2), TrainConfig(seed=4, device="cpu")])
def test_settings_round_trip_through_plain_values(config):
    assert type(config).from_dict(config.to_dict()) == config


@pytest.mark.parametrize("cls", [RewardConfig, TrainConfig])
def test_unknown_setting_is_named(cls):
    with pytest.raises(InvalidConfig) as error:
        cls.from_dict({**(DIMENSIONS if cls is RewardConfig else {}), "depth": 3})
    assert error.value.field == "depth"


def test_missing_dimension_is_named():
    with pytest.raises(InvalidConfig) as error:
        RewardConfig.from_dict({"observation_dim": 9, "action_dim": 1})
    assert error.value.field == "n_agents"


@pytest.mark.parametrize("cls", [RewardConfig, TrainConfig])
def test_unknown_preset_is_refused(cls):
    dimensions = {**DIMENSIONS, "segment_steps": 50} if cls is RewardConfig else {}
    with pytest.raises(InvalidConfig):
        cls.preset("huge", **dimensions)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hidden_dim", 0),
        ("hidden_dim", 6),
        ("hidden_dim", "64"),
        ("n_agents", True),
        ("layers", 1.5),
        ("temporal", "gru"),
        ("dropout", 1.0),
        ("dropout", float("nan")),
        ("cpa", 1),
    ],
)
def test_invalid_network_setting_is_refused(name, value):
    with pytest.raises(InvalidConfig) as error:
        RewardConfig.from_dict({**DIMENSIONS, "heads": 2, name: value})
    assert error.value.field == name


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("lr", 0.0),
        ("lr", "fast"),
        ("markov_lr", float("nan")),
        ("batch_pairs", 0),
        ("max_epochs", -1),
        ("markov_epochs", -1),
        ("patience", 0),
        ("hold_out_fraction", 0.9),
        ("weight_decay", -1.0),
        ("markov_weight_decay", -1.0),
        ("seed", -1),
    ],
)
def test_invalid_training_setting_is_refused(name, value):
    with pytest.raises(InvalidConfig) as error:
        TrainConfig.from_dict({name: value})
    assert error.value.field == name


@pytest.mark.parametrize("path", ["", "markov_"])
def test_weight_decay_that_would_reverse_weights_is_refused(path):
    with pytest.raises(InvalidConfig) as error:
        TrainConfig.from_dict({f"{path}lr": 0.5, f"{path}weight_decay": 2.0})
    assert error.value.field == f"{path}weight_decay"
    TrainConfig.from_dict({f"{path}lr": 0.5, f"{path}weight_decay": 1.9})
