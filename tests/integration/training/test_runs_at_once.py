"""mapt train with several seeds at once: real processes, killed and stopped on purpose."""

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from integration.training.test_killed_run import ENVIRONMENT, ITERATIONS, command
from mapt.errors import RunBusy
from mapt.training.metrics import read_metrics
from mapt.training.run_folder import RunFolder
from support.training_runs import reward_model, write_reward
from support.waiting import until

SEEDS = (3, 4)


def at_once(tmp_path: Path, name: str) -> list[str]:
    return command(tmp_path / name, tmp_path / "reward", "--seed", "3,4", "--workers", "2")


def folders(tmp_path: Path, name: str) -> list[RunFolder]:
    return [RunFolder(tmp_path / name / f"seed-{seed}") for seed in SEEDS]


def lines(folder: RunFolder) -> int:
    return len(read_metrics(folder.metrics)) if folder.metrics.exists() else 0


def completed(arguments: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(arguments, env=ENVIRONMENT, capture_output=True, text=True, check=False)


@contextmanager
def under_way(tmp_path: Path, name: str) -> Iterator[subprocess.Popen[str]]:
    """The command, once every run of it has a few lines."""
    with subprocess.Popen(
        at_once(tmp_path, name), env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            until(
                lambda: process.poll() is not None or min(map(lines, folders(tmp_path, name))) >= 3,
                "three lines of each",
            )
            assert process.poll() is None
            yield process
        finally:
            process.kill()


def worker_of(process: subprocess.Popen[str], folder: RunFolder) -> int:
    """The child of a command that holds a run's lock."""
    lock = str((folder.path / "lock").resolve())
    for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
        if lock in {os.readlink(open_file) for open_file in Path(f"/proc/{child}/fd").iterdir()}:
            return int(child)
    raise AssertionError(f"No child of {process.pid} holds {lock}.")


def is_free(folder: RunFolder) -> bool:
    try:
        with folder.locked():
            return True
    except RunBusy:
        return False


def last_saved(folder: RunFolder) -> object:
    stored = folder.last_checkpoint()
    return stored.progress["iteration"] if stored else None


@pytest.fixture(autouse=True)
def reward(tmp_path: Path, short_episodes: None) -> None:
    write_reward(tmp_path / "reward", reward_model())


def test_seeds_at_once_give_the_bytes_of_seeds_in_turn(tmp_path):
    together = completed(at_once(tmp_path, "together"))
    assert together.returncode == 0, together.stderr
    assert together.stdout.count("over 32 episodes") == len(SEEDS)
    in_turn = completed([*at_once(tmp_path, "turn"), "--workers", "1"])
    assert in_turn.returncode == 0, in_turn.stderr
    for ours, theirs in zip(folders(tmp_path, "together"), folders(tmp_path, "turn"), strict=True):
        assert ours.checkpoint.read_bytes() == theirs.checkpoint.read_bytes()
        assert ours.evaluation.read_bytes() == theirs.evaluation.read_bytes()


def test_a_killed_seed_leaves_the_others_be_and_goes_on(tmp_path):
    killed, other = folders(tmp_path, "runs")
    with under_way(tmp_path, "runs") as process:
        os.kill(worker_of(process, killed), signal.SIGKILL)
        _, errors = process.communicate()
    assert process.returncode == 2
    assert "seed 3: its worker process died (exit status -9)" in errors
    assert other.evaluation.exists()
    assert not killed.evaluation.exists()

    again = completed(at_once(tmp_path, "runs"))
    assert again.returncode == 0, again.stderr
    assert [lines(folder) for folder in (killed, other)] == [ITERATIONS, ITERATIONS]


def test_asked_to_stop_every_seed_saves_its_last_iteration(tmp_path):
    with under_way(tmp_path, "runs") as process:
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate()
    assert (process.returncode, "the same command goes on" in errors) == (130, True)
    for folder in folders(tmp_path, "runs"):
        assert is_free(folder)
        assert last_saved(folder) == lines(folder) < ITERATIONS


def test_no_seed_outlives_a_command_that_was_killed(tmp_path):
    with under_way(tmp_path, "runs") as process:
        process.kill()
    for folder in folders(tmp_path, "runs"):
        until(lambda folder=folder: is_free(folder), f"the end of the run in {folder.path}")
        assert last_saved(folder) == lines(folder) < ITERATIONS


def test_a_seed_that_cannot_be_trained_is_told_in_a_sentence(tmp_path):
    broken, other = folders(tmp_path, "runs")
    broken.path.mkdir(parents=True)
    (broken.path / "run.json").write_text("{}")
    ended = completed(at_once(tmp_path, "runs"))
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "seed 3:" in ended.stderr
    assert "cannot be read" in ended.stderr
    assert other.evaluation.exists()
