"""A sweep of `mapt train --ray` on a cluster that loses a node."""

import subprocess
import sys
from pathlib import Path
from typing import Any

from integration.cluster.conftest import ENVIRONMENT, NODE
from integration.training.test_killed_run import metrics_without_timings
from mapt.training.metrics import read_metrics
from mapt.training.results import find_runs
from mapt.training.run_folder import RunFolder
from support import short_tasks
from support.waiting import until

N_ITERATIONS = 24
TINY = ("n_envs=4", "rollout_steps=24", "minibatches=2", "epochs=2", "hidden=[8]")


def command(output: Path, *more: str) -> list[str]:
    return [
        *(sys.executable, "-m", "mapt.cli", "train", "--task", short_tasks.SHORTEST_NAME, "--output", str(output)),
        *("--steps", str(N_ITERATIONS * 4 * 24), "--device", "cpu", "--no-video", "--checkpoint-minutes", "0"),
        *(argument for setting in TINY for argument in ("--set", setting)),
        *("--seeds", "3,4", "--sweep", "clip=0.1,0.3", *more),
    ]


def test_a_sweep_survives_the_loss_of_a_node_and_equals_the_one_on_this_machine(cluster: Any, tmp_path: Path) -> None:
    nodes = [cluster.add_node(**NODE) for _ in range(2)]
    output = tmp_path / "cluster"
    with subprocess.Popen(
        command(output, "--ray", cluster.address),
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        until(lambda: process.poll() is not None or len(running(output)) >= 2, "iterations of two runs")
        cluster.remove_node(nodes.pop(), allow_graceful=False)
        printed, _ = process.communicate(timeout=240)
    assert process.returncode == 0, printed
    for node in nodes:
        cluster.remove_node(node)
    subprocess.run(command(tmp_path / "here", "--workers", "1"), env=ENVIRONMENT, check=True, capture_output=True)
    ours, theirs = (sorted(find_runs([path]), key=lambda each: each.path) for path in (output, tmp_path / "here"))
    assert len(ours) == 4
    for one, other in zip(ours, theirs, strict=True):
        lines = metrics_without_timings(one)
        assert [line["iteration"] for line in lines] == [*range(1, N_ITERATIONS + 1)]
        assert lines == metrics_without_timings(other)


def running(output: Path) -> list[RunFolder]:
    """The runs that have some iterations, and more to do."""
    folders = [RunFolder(path.parent) for path in output.glob("*/*/metrics.jsonl")]
    return [each for each in folders if 3 <= len(read_metrics(each.metrics)) < N_ITERATIONS]
