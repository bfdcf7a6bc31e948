"""Validation of a policy's settings."""

import json
from typing import get_args

import pytest

from mapt.errors import InvalidConfig
from mapt.policies import PolicyConfig
from mapt.policies.config import Algorithm
from mapt.tasks import task_names, task_spec


def test_configuration_round_trips_through_json() -> None:
    config = PolicyConfig(hidden=(32, 16), shared_actor=False, seed=3)
    assert PolicyConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_omitted_settings_keep_their_defaults() -> None:
    assert PolicyConfig.from_dict({"gamma": 0.9}) == PolicyConfig(gamma=0.9)


def test_settings_override_the_defaults_of_the_algorithm() -> None:
    named = PolicyConfig.named("mat", gamma=0.9)
    assert named == PolicyConfig.from_dict({"algorithm": "mat", "gamma": 0.9})
    assert (named.algorithm, named.gamma) == ("mat", 0.9)
    assert named.learning_rate < PolicyConfig().learning_rate
    assert PolicyConfig.named("mat", learning_rate=0.5).learning_rate == 0.5
    assert PolicyConfig.named("mappo") == PolicyConfig()


def test_settings_of_the_task_come_before_those_of_the_algorithm() -> None:
    hopper = task_spec("Hopper-3x1")
    assert PolicyConfig.for_task(hopper, {}) == PolicyConfig(**hopper.policy_settings)
    assert PolicyConfig.for_task(hopper, {"gamma": 0.999}) == PolicyConfig(**{**hopper.policy_settings, "gamma": 0.999})
    assert PolicyConfig.for_task(hopper, {"algorithm": "mat"}) == PolicyConfig.named("mat", **hopper.policy_settings)
    assert PolicyConfig.for_task(task_spec("HalfCheetah-6x1"), {"algorithm": "happo"}) == PolicyConfig.named("happo")


def test_shared_actor_of_a_task_is_left_out_for_happo() -> None:
    skirmish = task_spec("3m")
    assert PolicyConfig.for_task(skirmish, {}).shared_actor
    assert not PolicyConfig.for_task(skirmish, {"algorithm": "happo"}).shared_actor
    with pytest.raises(InvalidConfig):
        PolicyConfig.for_task(skirmish, {"algorithm": "happo", "shared_actor": True})


@pytest.mark.parametrize("algorithm", get_args(Algorithm))
def test_every_task_has_valid_settings(algorithm: str) -> None:
    for name in task_names():
        config = PolicyConfig.for_task(task_spec(name), {"algorithm": algorithm})
        assert config.algorithm == algorithm


def test_settings_without_an_algorithm_are_mappos() -> None:
    before = {
        name: value
        for name, value in PolicyConfig(gamma=0.9).to_dict().items()
        if name not in {"algorithm", "width", "layers", "heads"}
    }
    assert PolicyConfig.from_dict(before) == PolicyConfig(gamma=0.9)


def test_discount_rises_by_the_same_factor_of_steps_that_count() -> None:
    config = PolicyConfig(initial_gamma=0.9, gamma=0.999, gamma_steps=200)
    horizons = [1 / (1 - config.gamma_at(steps)) for steps in (0, 100, 200, 300)]
    assert horizons == pytest.approx([10, 100, 1000, 1000])
    assert PolicyConfig(gamma=0.9).gamma_at(0) == 0.9


@pytest.mark.parametrize(("initial", "final"), [(0.99, 0.98), (0.99, 1.0)])
def test_discount_that_rises_must_end_higher_and_below_one(initial: float, final: float) -> None:
    with pytest.raises(InvalidConfig, match="at most gamma") as error:
        PolicyConfig(initial_gamma=initial, gamma=final, gamma_steps=1)
    assert error.value.field == "initial_gamma"
    assert PolicyConfig(initial_gamma=initial, gamma=final).gamma_at(0) == final


def test_happo_does_not_accept_a_shared_actor() -> None:
    with pytest.raises(InvalidConfig) as error:
        PolicyConfig.named("happo", shared_actor=True)
    assert error.value.field == "shared_actor"


def test_float_settings_accept_integers() -> None:
    assert PolicyConfig.from_dict({"gamma": 1}).gamma == 1


def test_error_for_an_unknown_setting_lists_the_known_ones() -> None:
    with pytest.raises(InvalidConfig) as error:
        PolicyConfig.from_dict({"learning_rte": 1e-3})
    assert error.value.field == "learning_rte"
    assert "learning_rate" in str(error.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n_envs", 0),
        ("rollout_steps", -1),
        ("epochs", 0),
        ("minibatches", 0),
        ("minibatches", 7),
        ("learning_rate", 0.0),
        ("learning_rate", float("nan")),
        ("anneal_steps", -1),
        ("clip", 0.0),
        ("gamma", 1.1),
        ("gae_lambda", -0.1),
        ("entropy_weight", -1.0),
        ("value_weight", -1.0),
        ("max_gradient_norm", 0.0),
        ("hidden", []),
        ("hidden", [64, 0]),
        ("activation", "swish"),
        ("algorithm", "ppo"),
        ("width", 0),
        ("layers", 0),
        ("heads", 3),
        ("value_statistics_rate", 0.0),
        ("seed", -1),
        ("n_threads", -1),
        ("device", "tpu"),
    ],
)
def test_error_for_a_value_out_of_range_names_the_setting(name: str, value: object) -> None:
    with pytest.raises(InvalidConfig) as error:
        PolicyConfig.from_dict({name: value})
    assert error.value.field == name


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n_envs", 32.0),
        ("n_envs", True),
        ("gamma", "0.9"),
        ("gamma", None),
        ("shared_actor", 1),
        ("hidden", 64),
        ("hidden", ["64"]),
        ("hidden", [True]),
        ("activation", 3),
    ],
)
def test_error_for_a_value_of_another_type_names_the_setting(name: str, value: object) -> None:
    with pytest.raises(InvalidConfig) as error:
        PolicyConfig.from_dict({name: value})
    assert error.value.field == name
