"""Validation, storage and comparison of the settings of a run."""

import dataclasses

import numpy as np
import pytest

from mapt.errors import InvalidConfig, RunBusy, RunMismatch
from mapt.preferences.dataset import PreferenceDataset
from mapt.tasks import task_spec
from mapt.training.preference_loop import RewardSettings
from mapt.training.run_folder import RunFolder
from mapt.training.settings import LearnedRewardSettings, RunSettings
from support.comparisons import made_records


def test_settings_read_back_as_they_were_written(settings, tmp_path):
    for reward in (None, LearnedRewardSettings("/somewhere", 5, "weighted", "individual")):
        run = settings(reward=reward, policy_learning_rate=1e-3)
        folder = RunFolder(tmp_path / str(reward is None))
        folder.path.mkdir()
        folder.claim(run)
        assert folder.settings() == run


def test_a_folder_with_another_run_is_not_changed(settings, tmp_path):
    folder = RunFolder(tmp_path)
    folder.claim(settings())
    with pytest.raises(RunMismatch) as caught:
        folder.claim(settings(policy_learning_rate=1e-3))
    assert caught.value.differences == ("policy.learning_rate: 0.002, not 0.001",)
    assert folder.settings() == settings()


def test_a_run_can_be_extended_but_not_shortened(settings, tmp_path):
    folder = RunFolder(tmp_path)
    for iterations, expected in ((3, 3), (5, 5), (4, 5)):
        folder.claim(settings(iterations))
        assert folder.settings() == settings(expected)


def test_two_processes_cannot_train_in_one_folder(tmp_path):
    folder = RunFolder(tmp_path / "run")
    with folder.locked(), pytest.raises(RunBusy), RunFolder(folder.path).locked():
        pass
    with folder.locked():
        pass


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"steps": 0}, "steps"),
        ({"evaluate_every_steps": -1}, "evaluate_every_steps"),
        ({"reward": {"path": "x", "segment_steps": 0}}, "segment_steps"),
        ({"reward": {"path": "x", "segment_steps": 5, "credit": "mine"}}, "credit"),
        ({"reward": {"path": "x", "segment_steps": 5, "kind": "all"}}, "policy_reward"),
        ({"unknown": 1}, None),
        ({"policy": 3}, None),
    ],
)
def test_invalid_settings_are_refused(settings, changes, field):
    with pytest.raises(InvalidConfig) as caught:
        RunSettings.from_dict({**settings().to_dict(), **changes})
    assert caught.value.field == field


def test_unknown_settings_of_the_policy_are_refused(settings):
    values = settings().to_dict()
    with pytest.raises(InvalidConfig):
        RunSettings.from_dict({**values, "policy": {"learning_rte": 1.0}})


def test_differences_ignore_the_number_of_steps(settings):
    run = settings()
    assert run.differences(dataclasses.replace(run, steps=10**9)) == []
    assert run.differences(dataclasses.replace(run, agent_obsk=0)) == ["agent_obsk: 1, not 0"]


@pytest.mark.parametrize("task", ["3m", "HalfCheetah-6x1"])
def test_the_reward_model_is_that_of_the_tasks_actions_and_episodes(task):
    spec = task_spec(task)
    pairs, labels = np.array([[0, 1], [2, 3]]), np.array([1.0, 0.0], dtype=np.float32)
    dataset = PreferenceDataset(made_records(4).segments, pairs, labels)
    network, training = RewardSettings(segment_steps=4).training(dataset, spec)
    assert network.discrete_actions == spec.discrete_actions == (task == "3m")
    assert training.subtract_mean == (not spec.can_terminate)
