"""`mapt train` with several seeds in parallel worker processes, which are killed and stopped."""

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from integration.training.test_killed_run import ENVIRONMENT, ITERATIONS, STEPS_PER_ITERATION, arguments, command
from mapt.errors import RunBusy
from mapt.training.metrics import read_metrics
from mapt.training.run_folder import RunFolder
from support.training_runs import reward_model, write_reward
from support.waiting import until

pytestmark = pytest.mark.slow

SEEDS = (3, 4)
#: for runs that are not interrupted
SHORT = ("--steps", str(8 * STEPS_PER_ITERATION))


PARALLEL = ("--seeds", "3,4", "--workers", "2")


def parallel_arguments(tmp_path: Path, name: str, *more: str) -> list[str]:
    return arguments(tmp_path / name, tmp_path / "reward", *PARALLEL, *more)


def folders(tmp_path: Path, name: str) -> list[RunFolder]:
    return [RunFolder(tmp_path / name / f"seed-{seed}") for seed in SEEDS]


def lines(folder: RunFolder) -> int:
    """The number of iterations in the metrics file."""
    return len(read_metrics(folder.metrics)) if folder.metrics.exists() else 0


@contextmanager
def running_command(tmp_path: Path, name: str) -> Iterator[subprocess.Popen[str]]:
    """The process of the command, once every run has three iterations. Killed at the end of the block."""
    with subprocess.Popen(
        command(tmp_path / name, tmp_path / "reward", *PARALLEL),
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            until(
                lambda: process.poll() is not None or min(map(lines, folders(tmp_path, name))) >= 3,
                "three iterations of each run",
            )
            assert process.poll() is None
            yield process
        finally:
            process.kill()


def worker_of(process: subprocess.Popen[str], folder: RunFolder) -> int:
    """The pid of the child process that holds the lock of a run."""
    lock = str((folder.path / "lock").resolve())
    for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
        if lock in {os.readlink(open_file) for open_file in Path(f"/proc/{child}/fd").iterdir()}:
            return int(child)
    raise AssertionError(f"No child of {process.pid} holds {lock}.")


def is_unlocked(folder: RunFolder) -> bool:
    try:
        with folder.locked():
            return True
    except RunBusy:
        return False


def last_saved(folder: RunFolder) -> object:
    """The iteration of the last checkpoint, or None."""
    stored = folder.last_checkpoint()
    return stored.progress["iteration"] if stored else None


@pytest.fixture(autouse=True)
def stored_reward(tmp_path: Path, short_episodes: None) -> None:
    write_reward(tmp_path / "reward", reward_model())


def test_parallel_seeds_give_the_same_files_as_sequential_seeds(tmp_path, mapt):
    parallel = mapt(*parallel_arguments(tmp_path, "parallel", *SHORT))
    assert parallel.status == 0, parallel.errors
    assert parallel.printed.count("over 32 episodes") == len(SEEDS)
    sequential = mapt(*parallel_arguments(tmp_path, "sequential", *SHORT, "--workers", "1"))
    assert sequential.status == 0, sequential.errors
    for first, second in zip(folders(tmp_path, "parallel"), folders(tmp_path, "sequential"), strict=True):
        assert first.checkpoint.read_bytes() == second.checkpoint.read_bytes()
        assert first.evaluation.read_bytes() == second.evaluation.read_bytes()


def test_a_killed_seed_does_not_affect_the_others_and_resumes(tmp_path, mapt):
    killed, other = folders(tmp_path, "runs")
    with running_command(tmp_path, "runs") as process:
        os.kill(worker_of(process, killed), signal.SIGKILL)
        _, errors = process.communicate()
    assert process.returncode == 2
    assert "seed 3: its worker process died (killed by SIGKILL)" in errors
    assert other.evaluation.exists()
    assert not killed.evaluation.exists()

    resumed = mapt(*parallel_arguments(tmp_path, "runs"))
    assert resumed.status == 0, resumed.errors
    assert [lines(folder) for folder in (killed, other)] == [ITERATIONS, ITERATIONS]


def test_sigterm_stops_every_seed_after_saving_its_last_iteration(tmp_path):
    with running_command(tmp_path, "runs") as process:
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate()
    assert (process.returncode, "Rerun the command to resume" in errors) == (130, True)
    for folder in folders(tmp_path, "runs"):
        assert is_unlocked(folder)
        assert last_saved(folder) == lines(folder) < ITERATIONS


def test_no_worker_outlives_a_killed_command(tmp_path):
    with running_command(tmp_path, "runs") as process:
        process.kill()
    for folder in folders(tmp_path, "runs"):
        until(lambda folder=folder: is_unlocked(folder), f"the run in {folder.path} releases its lock")
        assert last_saved(folder) == lines(folder) < ITERATIONS


def test_a_seed_that_cannot_start_is_reported_in_one_line(tmp_path, mapt):
    broken, other = folders(tmp_path, "runs")
    broken.path.mkdir(parents=True)
    (broken.path / "run.json").write_text("{}")
    failed = mapt(*parallel_arguments(tmp_path, "runs", *SHORT))
    assert failed.status == 2
    assert failed.errors.count("\n") == 1
    assert "seed 3:" in failed.errors
    assert "cannot be read" in failed.errors
    assert other.evaluation.exists()
