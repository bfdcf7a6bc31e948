"""`mapt benchmark paper` with tiny datasets, models and policies, killed, resumed and compared with its run folders."""

import csv
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from statistics import mean, stdev

import pytest

from mapt.training.run_folder import RunFolder
from mapt.training.settings import TRUE, ImitationSettings, LearnedRewardSettings, PairSettings
from support import short_tasks, unusable_task
from support.mapt_command import run_mapt
from support.training_runs import STEPS_PER_ITERATION
from support.waiting import until

# The benchmark that most of the tests read takes a minute.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("short_episodes")]

ENVIRONMENT = os.environ | short_tasks.ENVIRONMENT | {"OMP_NUM_THREADS": "1"}
TASK = short_tasks.SHORTEST_NAME
TRAINING = "hidden_dim=8:train.markov_epochs=1:train.max_epochs=1"
MODELS = [f"MAPT:{TRAINING}", f"MA-MLP:{TRAINING}"]
TINY = "n_envs=4:rollout_steps=24:minibatches=2:epochs=2:hidden=[8]"
POLICIES = [f"mat_dec:{TINY}:width=8"]
IMITATION = ["OMAR:batch=8:hidden=4", "MAGAIL:batch=8:hidden=4:cloning_steps=2", "O-MAPL:batch=2:hidden=4"]
SEEDS = [0, 1]
STEPS = 6 * STEPS_PER_ITERATION
#: policies that are untrained, trained on the true reward, by imitation, and on each model
N_RUNS = len(SEEDS) * len(POLICIES) * (2 + len(IMITATION) + len(MODELS))


def arguments(output: Path, *more: str) -> list[str]:
    return [
        *("benchmark", "paper", "--output", str(output), "--tasks", TASK, "--models", ",".join(MODELS)),
        *("--policies", ",".join(POLICIES), "--seeds", ",".join(map(str, SEEDS)), "--pairs", "30"),
        *("--imitation", ",".join(IMITATION), "--imitation-steps", "20"),
        *("--steps", str(STEPS), "--dataset-steps", "4096", "--segments", "60", "--segment-steps", "10"),
        *("--test-pairs", "50", "--checkpoint-minutes", "0", "--workers", "1", *more),
    ]


def start(output: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "mapt.cli", *arguments(output)]
    return subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def kill_when(output: Path, pattern: str) -> None:
    """Run the command until a file matches the pattern, then kill its process."""
    process = start(output)
    try:
        until(lambda: process.poll() is not None or list(output.glob(pattern)), pattern)
        assert process.poll() is None
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    finally:
        process.kill()
        process.wait()


def finished_units(output: Path) -> dict[Path, int]:
    """Files that mark a finished unit of work, with their times of modification."""
    marks = ("datasets/*/*/manifest.json", "cells/*.json", "runs/**/evaluation.json")
    return {path: path.stat().st_mtime_ns for pattern in marks for path in output.glob(pattern)}


def lines(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The output of an uninterrupted command."""
    output = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as monkeypatch:
        for name, value in short_tasks.ENVIRONMENT.items():
            monkeypatch.setenv(name, value)
        assert run_mapt(monkeypatch, *arguments(output)) == 0
    return output


def test_a_killed_benchmark_resumes_and_ends_with_the_same_results(tmp_path, whole, mapt):
    # A command that was killed after the datasets were recorded.
    shutil.copytree(whole / "datasets", tmp_path / "datasets")
    for pattern in ("cells/*.json", "runs/*/*/MAPT*/metrics.jsonl"):
        kill_when(tmp_path, pattern)
    done = finished_units(tmp_path)
    assert {"datasets", "cells", "runs"} <= {path.relative_to(tmp_path).parts[0] for path in done}
    assert len(done) < len(finished_units(whole))

    # Workers of the killed process finish their iteration before they release their run.
    def resume() -> bool:
        result = mapt(*arguments(tmp_path))
        assert result.status == 0 or "another process" in result.errors, result.errors
        return result.status == 0

    until(resume, "all results")
    assert {path: path.stat().st_mtime_ns for path in done} == done
    for name in ("returns.csv", "scores.csv"):
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes()


def test_the_tables_have_the_returns_of_the_run_folders(whole):
    runs = lines(whole / "returns.csv")
    assert len(runs) == N_RUNS
    returns: dict[tuple[str, str, str], float] = {}
    for line in runs:
        evaluation = RunFolder(whole / line["folder"]).read_evaluation(int(line["steps"]))
        assert evaluation is not None
        assert float(line["return"]) == evaluation.summary()["mean"]
        returns[line["policy"], line["reward"], line["seed"]] = float(line["return"])
    for line in runs:
        value, untrained, true = (
            returns[line["policy"], reward, line["seed"]] for reward in (line["reward"], "untrained", TRUE)
        )
        if true > untrained:
            assert float(line["score"]) == pytest.approx((value - untrained) / (true - untrained))
        else:
            assert line["score"] == ""
    page = (whole / "paper.md").read_text()
    for row in lines(whole / "scores.csv"):
        values = [returns[row["policy"], row["reward"], str(seed)] for seed in SEEDS]
        assert float(row["mean"]) == pytest.approx(mean(values))
        assert float(row["std"]) == pytest.approx(stdev(values))
        form = ",.0f" if abs(mean(values)) >= 100 else ",.2f"
        assert f"{mean(values):{form}} ± {stdev(values):{form}}" in page
    assert "results are missing" not in page


def test_each_policy_trains_on_the_frozen_model_of_its_seed(whole):
    learned = [line for line in lines(whole / "returns.csv") if line["reward"] in MODELS]
    assert len(learned) == len(SEEDS) * len(POLICIES) * len(MODELS)
    for line in learned:
        folder = RunFolder(whole / line["folder"])
        reward = folder.settings().reward
        assert isinstance(reward, LearnedRewardSettings)
        assert Path(reward.path) == whole / "models" / TASK / folder.path.name
        assert [path.name for path in folder.rewards.iterdir()] == ["version-1"]
        weights = (Path(reward.path) / "reward.safetensors").read_bytes()
        assert (folder.rewards / "version-1" / "reward.safetensors").read_bytes() == weights


def test_imitation_learns_from_the_data_of_its_seed(whole):
    found = [line for line in lines(whole / "returns.csv") if line["reward"] in IMITATION]
    assert len(found) == len(SEEDS) * len(POLICIES) * len(IMITATION)
    for line in found:
        reward = RunFolder(whole / line["folder"]).settings().reward
        assert isinstance(reward, ImitationSettings)
        (data,) = reward.data
        name = line["reward"].partition(":")[0]
        assert Path(data.path).name == f"seed-{line['seed']}"
        # MAGAIL imitates the policy on the true reward, whose demonstrations name its return.
        expert = whole / "experts" / TASK
        assert Path(data.path).is_relative_to(expert if name == "MAGAIL" else whole / "datasets" / TASK)
        assert (data.policy_return is not None) == (name == "MAGAIL")
        assert (reward.pairs, line["pairs"]) == ((PairSettings(30), "30") if name == "O-MAPL" else (None, ""))
    page = (whole / "paper.md").read_text()
    assert all(name in page for name in IMITATION)


def test_the_figures_of_the_page_exist(whole):
    page = (whole / "paper.md").read_text()
    shown = [line.partition("](")[2].rstrip(")") for line in page.splitlines() if line.startswith("![")]
    # Scores, learning curves and a rollout of each policy, and the distribution of rewards.
    assert {name.partition("-")[0] for name in shown} >= {"figures/curves", "figures/rewards", "figures/rollout"}
    for name in shown:
        assert (whole / name).read_bytes().startswith(b"\x89PNG")


def test_a_dry_run_of_a_moved_output_lists_what_is_missing_of_more_seeds(tmp_path, whole, mapt):
    moved = tmp_path / "moved"
    shutil.copytree(whole, moved)
    before = finished_units(moved)
    result = mapt(*arguments(moved, "--seeds", "0,1,2", "--dry-run"))
    assert result.status == 0, result.errors
    assert finished_units(moved) == before
    page = (moved / "paper.md").read_text()
    assert f"**{N_RUNS // len(SEEDS)} results are missing**" in page
    assert page.count(", seed 2\n") == N_RUNS // len(SEEDS)


def test_a_task_that_cannot_run_has_empty_cells_and_stops_no_other(tmp_path, mapt, monkeypatch):
    monkeypatch.setenv("MAPT_TASKS", os.pathsep.join([short_tasks.__file__, unusable_task.FILE]))
    tasks, seeds, models = ("--tasks", f"{unusable_task.NAME},{TASK}"), ("--seeds", "0"), ("--models", MODELS[1])
    result = mapt(*arguments(tmp_path, *tasks, *seeds, *models, "--imitation", "none", "--steps", "96"))
    assert result.status == 1
    assert unusable_task.REASON in result.errors
    assert "3 results are missing" in result.errors
    returns = {(line["task"], line["reward"]) for line in lines(tmp_path / "returns.csv")}
    assert returns == {(TASK, reward) for reward in ("untrained", TRUE, MODELS[1])}
    assert f"| {unusable_task.NAME} | 30 |  |  |  |" in (tmp_path / "paper.md").read_text()


def test_only_one_process_at_a_time_trains_in_a_folder(whole, mapt):
    with RunFolder(whole).locked():
        refused = mapt(*arguments(whole))
        assert refused.status == 2
        assert str(whole) in refused.errors
        # A dry run only reads results, so it may run beside the process that computes them.
        assert mapt(*arguments(whole, "--dry-run")).status == 0


def test_a_dataset_with_other_settings_is_refused(whole, mapt):
    refused = mapt(*arguments(whole, "--segments", "70"))
    assert refused.status == 2
    assert "segments: 60, not 70" in refused.errors


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--tasks", "Nowhere", "'Nowhere'"),
        ("--models", "Nobody", "'Nobody'"),
        ("--policies", "mappo:seed=1", "'mappo:seed=1'"),
        ("--policies", "sac", "algorithm"),
        ("--imitation", "Nobody", "'Nobody'"),
        ("--imitation", "OMAR:batch=0", "batch"),
        ("--pairs", "1", "--pairs"),
        ("--pair-distance", "2", "--pair-distance"),
    ],
)
def test_an_invalid_plan_is_refused_before_any_work(tmp_path, mapt, option, value, message):
    refused = mapt(*arguments(tmp_path / "out", option, value))
    assert refused.status == 2
    assert message in refused.errors
    assert not (tmp_path / "out").exists()
