"""Studies of `mapt` with `--ray`, on a cluster that loses a node: their results equal those of one machine."""

import csv
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from integration.cluster.conftest import ENVIRONMENT, NODE
from integration.training.test_killed_run import metrics_without_timings
from mapt.training.metrics import read_metrics
from mapt.training.results import find_runs
from mapt.training.run_folder import RunFolder
from support import short_tasks
from support.waiting import PATIENCE_SECONDS, until

TASK = short_tasks.SHORTEST_NAME
N_ITERATIONS = 24
TINY = ("n_envs=4", "rollout_steps=24", "minibatches=2", "epochs=2", "hidden=[8]")
#: A model trains for a fraction of a second, so that a node that is killed loses one.
SHORT = "train.markov_epochs=8:train.max_epochs=8"
ONE_EPOCH = "hidden_dim=8:train.markov_epochs=1:train.max_epochs=1"
N_CELLS = 24
#: columns of a table's cells that differ from run to run
TIMES = {"seconds", "cpu_seconds", "attention_trial_seconds"}


@pytest.fixture
def nodes(cluster: Any) -> Iterator[list[Any]]:
    """Two nodes of one core. A test may remove one, from the list too."""
    added = [cluster.add_node(**NODE) for _ in range(2)]
    yield added
    for node in added:
        cluster.remove_node(node)


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "mapt.cli", *map(str, arguments)]
    return subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def output_of(process: subprocess.Popen[str]) -> str:
    """Wait for a command that should succeed; return what it printed."""
    try:
        printed, _ = process.communicate(timeout=PATIENCE_SECONDS)
    finally:
        process.kill()
    assert process.returncode == 0, printed
    return printed


def sweep(output: Path) -> list[str | Path]:
    return [
        *("train", "--task", TASK, "--output", output, "--steps", str(N_ITERATIONS * 4 * 24), "--device", "cpu"),
        *("--no-video", "--checkpoint-minutes", "0", "--seeds", "3,4", "--sweep", "clip=0.1,0.3"),
        *(argument for setting in TINY for argument in ("--set", setting)),
    ]


def running(output: Path) -> list[RunFolder]:
    """The runs that have some iterations, and more to do."""
    folders = [RunFolder(path.parent) for path in output.glob("*/*/metrics.jsonl")]
    return [each for each in folders if 3 <= len(read_metrics(each.metrics)) < N_ITERATIONS]


def test_a_sweep_survives_the_loss_of_a_node_and_equals_the_one_on_this_machine(
    cluster: Any, nodes: list[Any], tmp_path: Path
) -> None:
    output = tmp_path / "cluster"
    process = start(*sweep(output), "--ray", cluster.address)
    until(lambda: process.poll() is not None or len(running(output)) >= 2, "iterations of two runs")
    cluster.remove_node(nodes.pop(), allow_graceful=False)
    output_of(process)
    output_of(start(*sweep(tmp_path / "here"), "--workers", "1"))
    ours, theirs = (sorted(find_runs([path]), key=lambda each: each.path) for path in (output, tmp_path / "here"))
    assert len(ours) == 4
    for one, other in zip(ours, theirs, strict=True):
        lines = metrics_without_timings(one)
        assert [line["iteration"] for line in lines] == [*range(1, N_ITERATIONS + 1)]
        assert lines == metrics_without_timings(other)


def collecting(output: Path, n_steps: int) -> list[str | Path]:
    """A run whose environments are in two slots."""
    return [
        *("train", "--task", TASK, "--output", output, "--steps", str(n_steps), "--device", "cpu", "--seeds", "3"),
        *("--no-video", "--set", "collectors=2"),
        *(argument for setting in TINY for argument in ("--set", setting)),
    ]


def test_a_run_whose_slots_are_collected_by_actors_equals_the_one_on_this_machine(
    cluster: Any, nodes: list[Any], tmp_path: Path
) -> None:
    """The run and its two actors take a core each. It is stopped soon after the actors have started."""
    nodes.append(cluster.add_node(**NODE))
    folder = RunFolder(tmp_path / "cluster" / "seed-3")
    process = start(*collecting(tmp_path / "cluster", 10_000_000), "--ray", cluster.address)

    def collected_by_actors() -> int:
        """Iterations in which the run has stepped no environment itself."""
        found = read_metrics(folder.metrics) if folder.metrics.exists() else []
        return sum(line["seconds_physics"] == 0 for line in found)

    try:
        until(lambda: process.poll() is not None or collected_by_actors() >= 5, "iterations without own steps")
        process.send_signal(signal.SIGINT)
        printed, _ = process.communicate(timeout=PATIENCE_SECONDS)
    finally:
        process.kill()
    assert "Rerun the command to resume" in printed, printed
    lines = metrics_without_timings(folder)
    assert collected_by_actors() >= 5
    output_of(start(*collecting(tmp_path / "here", int(lines[-1]["steps"])), "--workers", "1"))
    assert lines == metrics_without_timings(RunFolder(tmp_path / "here" / "seed-3"))


def table(output: Path) -> list[str | Path]:
    return [
        *("table", "--output", output, "--task", TASK, "--models", f"MAPT:{SHORT},MA-Transformer:{SHORT}"),
        *("--teachers", "oracle,phase", "--labels", "10,20,30", "--seeds", "0,1", "--steps", "1024"),
        *("--segments", "60", "--segment-steps", "10", "--test-pairs", "50", "--device", "cpu"),
    ]


def cells(output: Path) -> dict[Path, int]:
    """The files of the finished cells, with their times of modification."""
    return {path: path.stat().st_mtime_ns for path in output.glob("cells/*.json")}


def lines(path: Path) -> list[dict[str, str]]:
    """The lines of a CSV file without times."""
    with path.open(newline="") as file:
        return [{name: value for name, value in line.items() if name not in TIMES} for line in csv.DictReader(file)]


def test_each_cell_of_a_table_is_finished_once_although_one_of_three_nodes_is_lost(
    cluster: Any, nodes: list[Any], tmp_path: Path
) -> None:
    nodes.append(cluster.add_node(**NODE))
    output = tmp_path / "cluster"
    process = start(*table(output), "--ray", cluster.address)
    until(lambda: process.poll() is not None or len(cells(output)) >= 8, "eight cells")
    cluster.remove_node(nodes.pop(), allow_graceful=False)
    before = cells(output)
    assert 8 <= len(before) < N_CELLS
    printed = output_of(process)
    after = cells(output)
    assert len(after) == N_CELLS
    assert {path: after[path] for path in before} == before
    finished = [line.partition(": ")[0].partition(", ")[2] for line in printed.splitlines() if ": accuracy " in line]
    assert len(finished) == len(set(finished)) == N_CELLS
    output_of(start(*table(tmp_path / "here"), "--workers", "1"))
    assert lines(output / "cells.csv") == lines(tmp_path / "here" / "cells.csv")


def test_datasets_and_imitations_equal_those_of_this_machine(cluster: Any, nodes: list[Any], tmp_path: Path) -> None:
    def study(folder: Path, *where: str) -> None:
        recording = ("--task", TASK, "--seeds", "0,1", "--steps", "1024", "--segments", "24", "--segment-steps", "10")
        output_of(start("dataset", "--output", folder / "data", *recording, *where))
        policy = (argument for setting in TINY for argument in ("--set", f"policy.{setting}"))
        learning = ("--algorithm", "o-mapl", "--pairs", "8", "--steps", "20", "--set", "batch=8", "--no-video")
        data = folder / "data" / "seed-0"
        output_of(start("imitate", "--data", data, "--output", folder / "runs", *learning, *policy, *where))

    study(tmp_path / "cluster", "--ray", cluster.address)
    study(tmp_path / "here", "--workers", "1")
    for pattern, number in (("data/seed-*/*", 14), ("runs/seed-0/checkpoint.safetensors", 1), ("runs/*/eval*.json", 1)):
        found = sorted((tmp_path / "cluster").glob(pattern))
        assert len([path for path in found if path.is_file()]) == number
        for path in found:
            other = tmp_path / "here" / path.relative_to(tmp_path / "cluster")
            assert path.is_dir() or path.read_bytes() == other.read_bytes(), path


def test_the_tables_of_the_paper_equal_those_of_this_machine(cluster: Any, nodes: list[Any], tmp_path: Path) -> None:
    def study(output: Path, *where: str) -> None:
        tiny = ":".join(TINY)
        output_of(
            start(
                *("benchmark", "paper", "--output", output, "--tasks", TASK, "--models", f"MAPT:{ONE_EPOCH}"),
                *("--policies", f"mappo:{tiny}", "--imitation", "OMAR:batch=8:hidden=4", "--imitation-steps", "20"),
                *("--seeds", "0", "--pairs", "30", "--steps", "192", "--dataset-steps", "1024", "--segments", "60"),
                *("--segment-steps", "10", "--test-pairs", "50", "--device", "cpu", *where),
            )
        )

    study(tmp_path / "cluster", "--ray", cluster.address)
    study(tmp_path / "here", "--workers", "1")
    for name in ("returns.csv", "scores.csv"):
        ours, theirs = (tmp_path / where / name for where in ("cluster", "here"))
        assert len(lines(ours)) > 1
        assert ours.read_bytes() == theirs.read_bytes()
