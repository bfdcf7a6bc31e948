"""`mapt train` as a process that is killed or stopped: its files equal those of an uninterrupted run."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mapt.training.metrics import EVENTS, Metrics, read_metrics
from mapt.training.run_folder import RunFolder
from support import short_tasks
from support.training_runs import TIMINGS, reward_model, write_reward
from support.waiting import until

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("short_episodes")]

STEPS_PER_ITERATION = 4 * 24
#: enough to kill the run long before its end
ITERATIONS = 28
ENVIRONMENT = os.environ | short_tasks.ENVIRONMENT | {"OMP_NUM_THREADS": "1"}
#: close to the duration of an iteration, so that only some iterations have a checkpoint
CHECKPOINT_MINUTES = "0.003"


def arguments(output: Path, reward: Path, *more: str) -> list[str]:
    tiny = ("n_envs=4", "rollout_steps=24", "minibatches=2", "epochs=2", "width=8", "hidden=[8]")
    return [
        *("train", "--task", short_tasks.SHORTEST_NAME, "--algorithm", "mat"),
        *("--reward", str(reward), "--credit", "individual", "--steps", str(ITERATIONS * STEPS_PER_ITERATION)),
        *("--output", str(output), "--seeds", "3", "--evaluate-every", "1500", "--device", "cpu", "--no-video"),
        *("--checkpoint-minutes", CHECKPOINT_MINUTES),
        *(argument for setting in tiny for argument in ("--set", setting)),
        *more,
    ]


def command(output: Path, reward: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "mapt.cli", *arguments(output, reward, *more)]


def kill_after(lines: int, output: Path, reward: Path, number: int = signal.SIGKILL) -> int:
    """Start the run, send the signal once it has written `lines` metrics lines, and return its exit status."""
    folder = RunFolder(output / "seed-3")
    process = subprocess.Popen(
        command(output, reward), env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        until(
            lambda: (
                process.poll() is not None or (folder.metrics.exists() and len(read_metrics(folder.metrics)) >= lines)
            ),
            f"{lines} lines of metrics",
        )
        assert process.poll() is None
        process.send_signal(number)
        return process.wait()
    finally:
        process.kill()
        process.wait()


def metrics_without_timings(folder: RunFolder) -> list[Metrics]:
    """The metrics of a run without its timings, which differ from run to run."""
    return [
        {name: value for name, value in line.items() if name not in TIMINGS} for line in read_metrics(folder.metrics)
    ]


def test_a_killed_run_resumes_and_ends_with_the_files_of_an_uninterrupted_run(tmp_path, mapt):
    reward = tmp_path / "reward"
    write_reward(reward, reward_model())
    for lines in (4, 10):
        assert kill_after(lines, tmp_path / "killed", reward) == -signal.SIGKILL
    for name in ("killed", "whole"):
        done = mapt(*arguments(tmp_path / name, reward))
        assert done.status == 0, done.errors
    killed, whole = (RunFolder(tmp_path / name / "seed-3") for name in ("killed", "whole"))

    assert killed.checkpoint.read_bytes() == whole.checkpoint.read_bytes()
    assert killed.evaluation.read_bytes() == whole.evaluation.read_bytes()
    lines = metrics_without_timings(killed)
    assert [line["iteration"] for line in lines] == list(range(1, ITERATIONS + 1))
    assert lines == metrics_without_timings(whole)
    assert any("evaluation_mean" in line for line in lines)

    events = EventAccumulator(str(killed.path), size_guidance={"scalars": 0}).Reload()
    assert len(list(killed.path.glob(EVENTS))) == 1
    assert [event.step for event in events.Scalars("learner/kl")] == [line["steps"] for line in lines]


def test_a_stopped_run_saves_its_last_iteration(tmp_path):
    reward = tmp_path / "reward"
    write_reward(reward, reward_model())
    assert kill_after(4, tmp_path / "stopped", reward, signal.SIGTERM) == 130
    stopped = RunFolder(tmp_path / "stopped" / "seed-3")
    stored = stopped.last_checkpoint()
    assert stored is not None
    assert stored.progress["iteration"] == len(read_metrics(stopped.metrics)) < ITERATIONS
    assert not stopped.evaluation.exists()
