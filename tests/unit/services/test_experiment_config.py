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
)
from mapt.preferences.selection import selector_names
from mapt.rewards.config import MODEL_NAMES, PresetName
from mapt.rewards.model import PolicyReward as LibraryPolicyReward


def config(**changes: object) -> ExperimentConfig:
    return ExperimentConfig(task="HalfCheetah-6x1", **changes)  # type: ignore[arg-type]


def test_the_words_are_those_of_the_library():
    assert get_args(QuerySelection) == selector_names()
    assert set(get_args(RewardPreset)) == set(get_args(PresetName))
    assert get_args(RewardModelName) == MODEL_NAMES
    assert get_args(PolicyReward) == get_args(LibraryPolicyReward)


@pytest.mark.parametrize(
    ("setting", "known"),
    [
        ("query_selection", get_args(QuerySelection)),
        ("reward_preset", get_args(RewardPreset)),
        ("policy_reward", get_args(PolicyReward)),
        ("credit", get_args(Credit)),
        ("label_schedule", ("power", "constant", "decaying")),
        ("pacing", ("wait", "free")),
        ("reward_source", ("preferences", "true")),
    ],
)
def test_an_unknown_word_is_refused_with_the_known_ones(setting, known):
    # An experiment that was stored with it can still be read.
    stored = config(**{setting: "huge"})
    with pytest.raises(InvalidExperiment, match=f"^{setting} is 'huge'; it must be one of: {', '.join(known)}\\.$"):
        stored.check_names()
    for word in known:
        config(**{setting: word}).check_names()


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("control_share", -0.1),
        ("control_share", 1.1),
        ("control_share", float("nan")),
        ("label_noise", 0.5),
        ("ensemble_members", 1),
        ("ensemble_members", 17),
    ],
)
def test_a_number_out_of_range_is_refused(setting, value):
    with pytest.raises(InvalidExperiment, match=setting):
        config(**{setting: value})


def test_a_stored_experiment_without_the_newer_settings_reads_as_before():
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
    read = ExperimentConfig(**stored)  # type: ignore[arg-type]
    assert (read.label_schedule, read.query_selection) == ("power", "uniform")
    assert read == config()
