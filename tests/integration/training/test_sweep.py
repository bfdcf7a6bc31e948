"""Sweeps of `mapt train` over a run file: killed and resumed, and divided among the tasks of an array."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from integration.training.test_killed_run import ENVIRONMENT, metrics_without_timings
from mapt.training.results import find_runs
from mapt.training.run_folder import RunFolder
from support import short_tasks
from support.waiting import until

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("short_episodes")]

N_ITERATIONS = 6
FILE = f"""\
task = "{short_tasks.SHORTEST_NAME}"
steps = {N_ITERATIONS * 4 * 24}
seeds = [3]
device = "cpu"

[policy]
algorithm = "mappo"
n_envs = 4
rollout_steps = 24
minibatches = 2
epochs = 2
hidden = [8]
"""
SWEEPS = ("--sweep", "clip=0.1,0.3", "--sweep", "gamma=0.9,0.99")
CELLS = ("clip=0.1,gamma=0.9", "clip=0.1,gamma=0.99", "clip=0.3,gamma=0.9", "clip=0.3,gamma=0.99")


@pytest.fixture
def run_file(tmp_path: Path) -> Path:
    path = tmp_path / "run.toml"
    path.write_text(FILE)
    return path


def start(run_file: Path, output: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "mapt.cli", "train", str(run_file), "--output", str(output), "--no-video"]
    common = ["--checkpoint-minutes", "0", "--workers", "1"]
    return subprocess.Popen(
        [*command, *SWEEPS, *common, *more],  # of an option given twice, the last one counts
        env=ENVIRONMENT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )


def finish(process: subprocess.Popen[str]) -> str:
    printed, _ = process.communicate(timeout=240)
    assert process.returncode == 0, printed
    return printed


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_sweep_is_killed_and_resumed(run_file: Path, tmp_path: Path, workers: str) -> None:
    output = tmp_path / "sweep"
    second = RunFolder(output / CELLS[1] / "seed-3")
    with start(run_file, output, "--workers", workers) as process:
        until(lambda: process.poll() is not None or second.metrics.exists(), "the second cell's first iteration")
        process.send_signal(signal.SIGKILL)
    assert not (output / CELLS[3]).exists()

    printed = finish(start(run_file, output, "--workers", workers))
    assert f"{CELLS[3]}, seed 3: true return" in printed
    assert sorted(folder.path.parent.name for folder in find_runs([output])) == sorted(CELLS)
    for cell in CELLS:
        folder = RunFolder(output / cell / "seed-3")
        assert [line["iteration"] for line in metrics_without_timings(folder)] == [*range(1, N_ITERATIONS + 1)]
        assert folder.evaluation.exists()
        policy = folder.settings().policy
        assert cell == f"clip={policy.clip},gamma={policy.gamma}"


def test_tasks_of_an_array_train_each_cell_once(run_file: Path, tmp_path: Path) -> None:
    output = tmp_path / "array"
    tasks = [start(run_file, output, "--only", f"{number}/3", "--steps", "96") for number in (1, 2, 3)]
    shares = [{cell for cell in CELLS if f"{cell}, seed 3" in printed} for printed in map(finish, tasks)]
    assert shares == [{CELLS[0], CELLS[3]}, {CELLS[1]}, {CELLS[2]}]
    runs = find_runs([output])
    # The option --steps replaces the file's.
    assert [len(metrics_without_timings(folder)) for folder in runs] == [1, 1, 1, 1]


def test_a_task_of_a_larger_array_than_there_are_runs_says_so(run_file: Path, tmp_path: Path) -> None:
    printed = finish(start(run_file, tmp_path / "none", "--only", "5/12"))
    assert "--only 5/12" in printed
    assert not (tmp_path / "none").exists()


def test_a_sweep_with_an_impossible_value_leaves_nothing_behind(run_file: Path, tmp_path: Path) -> None:
    process = start(run_file, tmp_path / "none", "--sweep", "hidden=[8],[0]")
    printed, _ = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "hidden" in printed
    assert not (tmp_path / "none").exists()
