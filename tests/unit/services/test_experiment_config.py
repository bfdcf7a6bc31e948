"""Validation of an experiment's settings."""

from typing import get_args

import pytest

from accord.domain.errors import InvalidExperiment
from accord.services.experiment_config import (
    Credit,
    ExperimentConfig,
    PolicyReward,
    QuerySelection,
    RewardModelName,
    RewardPreset,
    read_config,
)
from mapt.errors import InvalidConfig
from mapt.preferences.selection import selector_names
from mapt.rewards.config import MODEL_NAMES, PresetName
from mapt.rewards.model import PolicyReward as LibraryPolicyReward
from mapt.settings import describe


def config(**changes: object) -> ExperimentConfig:
    return ExperimentConfig(task="HalfCheetah-6x1", **changes)  # type: ignore[arg-type]


def test_choices_equal_those_of_mapt():
    assert get_args(QuerySelection) == selector_names()
    assert set(get_args(RewardPreset)) == set(get_args(PresetName))
    assert get_args(RewardModelName) == MODEL_NAMES
    assert get_args(PolicyReward) == get_args(LibraryPolicyReward)


@pytest.mark.parametrize(
    ("setting", "choices"),
    [
        ("query_selection", get_args(QuerySelection)),
        ("reward_preset", get_args(RewardPreset)),
        ("policy_reward", get_args(PolicyReward)),
        ("credit", get_args(Credit)),
        ("label_schedule", ("power", "constant", "decaying")),
        ("pacing", ("wait", "labels", "free")),
        ("reward_source", ("preferences", "true")),
    ],
)
def test_every_choice_is_accepted_and_another_is_refused(setting, choices):
    for choice in choices:
        config(**{setting: choice})
    with pytest.raises(InvalidConfig) as caught:
        config(**{setting: "huge"})
    assert caught.value.field == setting
    assert ", ".join(choices) in str(caught.value)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("control_share", -0.1),
        ("control_share", 1.1),
        ("control_share", float("nan")),
        ("label_noise", 0.5),
        ("ensemble_members", 1),
        ("ensemble_members", 17),
        ("initial_labels", 1),
        ("initial_labels", 501),
        ("total_steps", "many"),
        ("total_steps", True),
        ("seed", 2**31),
        ("device", "tpu"),
    ],
)
def test_error_for_a_value_of_the_wrong_type_or_out_of_range_names_the_setting(setting, value):
    with pytest.raises(InvalidConfig) as caught:
        config(**{setting: value})
    assert caught.value.field == setting


@pytest.mark.parametrize(
    ("policy", "field"),
    [
        ({"n_envs": 0}, "policy.n_envs"),
        ({"n_environments": 4}, "policy.n_environments"),
        ({"algorithm": "ppo"}, "policy.algorithm"),
        ({"hidden": [32, 0]}, "policy.hidden"),
        ({"heads": 3}, "policy.heads"),
        ({"rollout_steps": 25, "minibatches": 1}, "policy.rollout_steps"),
        (5, "policy"),
    ],
)
def test_error_for_an_invalid_policy_setting_names_it(policy, field):
    with pytest.raises(InvalidExperiment) as caught:
        read_config({"task": "HalfCheetah-6x1", "policy": policy})
    assert caught.value.field == field
    assert str(caught.value).startswith(field)


def test_policy_inherits_the_seed_of_the_experiment_unless_it_sets_its_own():
    assert config(seed=7, policy={"hidden": [32, 32]}).policy_config().seed == 7
    own = config(seed=7, policy={"seed": 8, "hidden": [32, 32]}).policy_config(n_threads=3)
    assert (own.seed, own.hidden, own.n_threads) == (8, (32, 32), 3)


def test_experiment_with_the_true_reward_needs_no_labels():
    config(reward_source="true", label_budget=0, initial_labels=0)


def test_stored_experiment_without_newer_settings_has_their_defaults():
    stored = config().to_dict()
    for newer in (
        "label_schedule",
        "query_selection",
        "control_share",
        "ensemble_members",
        "reward_model",
        "label_noise",
    ):
        del stored[newer]
    read = ExperimentConfig.from_stored(stored)
    assert (read.label_schedule, read.query_selection) == ("power", "recent")
    assert read == config()


def test_stored_experiment_with_a_choice_of_another_version_can_be_read():
    assert ExperimentConfig.from_stored(config().to_dict() | {"reward_preset": "huge"}).reward_preset == "huge"


def test_every_number_has_a_minimum_and_a_maximum():
    for row in describe(ExperimentConfig):
        if "number" in row.range:
            assert " from " in row.range or " and at most " in row.range, row
