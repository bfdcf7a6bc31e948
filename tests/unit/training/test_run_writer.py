"""The run folder of a preference loop."""

import pytest

from mapt.errors import AlreadyExists, InvalidConfig
from mapt.policies import Learner
from mapt.preferences.teachers import OracleTeacher
from mapt.tasks import make_task
from mapt.training.metrics import read_metrics
from mapt.training.preference_loop import PreferenceLoop, RewardSettings
from mapt.training.results import RunResult
from mapt.training.run_folder import RunFolder, load_policy
from mapt.training.schedule import LabelSchedule
from mapt.training.settings import PreferenceRewardSettings, RunSettings


def make_loop(settings: RunSettings, output, **options: object) -> PreferenceLoop:
    task = make_task(settings.task, settings.policy.n_envs, n_threads=1, **options)
    schedule = LabelSchedule(4, initial=2, per_version=2, total_steps=settings.steps)
    reward = RewardSettings(segment_steps=5, device="cpu")
    return PreferenceLoop(Learner(task, settings.policy), OracleTeacher(), schedule, reward, output=output)


def test_a_preference_loop_writes_a_run_folder(settings, tmp_path):
    run, folder = settings(iterations=3), RunFolder(tmp_path / "run")
    loop = make_loop(run, folder.path)
    loop.run()
    lines = read_metrics(folder.metrics)
    assert [line["iteration"] for line in lines] == [1, 2, 3]
    assert [{name: line[name] for name in metrics} for line, metrics in zip(lines, loop.history, strict=True)] == (
        loop.history
    )
    found = RunResult.read(folder)
    assert found.settings.reward == PreferenceRewardSettings("MAPT", 4, 2, 2, "oracle")
    assert found.steps == run.steps == found.evaluations[-1].steps == load_policy(folder.path).steps


def test_a_folder_with_a_run_is_not_overwritten(settings, tmp_path):
    RunFolder(tmp_path).claim(settings())
    with pytest.raises(AlreadyExists):
        make_loop(settings(), tmp_path).run()


def test_a_task_that_its_name_does_not_determine_is_refused(settings, tmp_path):
    with pytest.raises(InvalidConfig) as refused:
        make_loop(settings(), tmp_path / "run", agent_obsk=0).run()
    assert refused.value.field == "output"
    assert not (tmp_path / "run").exists()
