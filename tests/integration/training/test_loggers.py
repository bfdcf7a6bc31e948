"""Runs of `mapt train` that are logged to Weights & Biases offline, and to a real MLflow server.

Both packages are extras: `make test-loggers` installs them; without them, their tests are skipped.
"""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from urllib.request import urlopen

import pytest

from integration.training.test_killed_run import ENVIRONMENT
from mapt.training.metrics import read_metrics
from mapt.training.run_folder import RunFolder
from support import short_tasks
from support.waiting import until

pytestmark = pytest.mark.usefixtures("short_episodes")

#: installed by `make test-loggers`
MLFLOW_SERVER = Path(sys.prefix, "mlflow-server", "bin", "mlflow")
N_ITERATIONS = 30
TINY = ("n_envs=4", "rollout_steps=24", "minibatches=2", "epochs=2", "hidden=[8]")


def command(output: Path, logger: str) -> list[str]:
    return [
        *(sys.executable, "-m", "mapt.cli", "train", "--task", short_tasks.SHORTEST_NAME, "--output", str(output)),
        *("--steps", str(N_ITERATIONS * 4 * 24), "--device", "cpu", "--no-video", "--checkpoint-minutes", "0"),
        *(argument for setting in TINY for argument in ("--set", setting)),
        *("--log", logger),
    ]


def train(output: Path, logger: str, **environment: str) -> str:
    done = subprocess.run(
        command(output, logger), env=ENVIRONMENT | environment, capture_output=True, text=True, check=True, timeout=240
    )
    return done.stdout + done.stderr


def killed(output: Path, logger: str, **environment: str) -> None:
    """Train, and kill the process after a few iterations."""
    folder = RunFolder(output / "seed-0")
    with subprocess.Popen(command(output, logger), env=ENVIRONMENT | environment, stdout=subprocess.DEVNULL) as process:
        until(
            lambda: process.poll() is not None or (folder.metrics.exists() and len(read_metrics(folder.metrics)) >= 3),
            "three iterations",
        )
        assert process.poll() is None
        process.send_signal(signal.SIGKILL)


def test_an_unknown_logger_and_a_missing_package_are_refused_before_any_work(tmp_path: Path) -> None:
    wanted = {"nobody": "There is no logger 'nobody'. The loggers are: wandb, mlflow."}
    wanted |= {name: f"pip install 'accord[{name}]'" for name in ("wandb", "mlflow") if find_spec(name) is None}
    for name, message in wanted.items():
        done = subprocess.run(
            command(tmp_path / "out", name), env=ENVIRONMENT, capture_output=True, text=True, check=False
        )
        assert done.returncode == 2
        assert message in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(find_spec("wandb") is None, reason="wandb is not installed (make test-loggers)")
def test_wandb_gets_a_run_that_is_killed_and_resumed_under_one_id(tmp_path: Path) -> None:
    killed(tmp_path, "wandb", WANDB_MODE="offline")
    train(tmp_path, "wandb", WANDB_MODE="offline")
    parts = sorted((tmp_path / "seed-0" / "wandb").glob("offline-run-*/*.wandb"))
    assert len(parts) == 2
    assert len({path.name for path in parts}) == 1
    content = parts[1].read_bytes()
    last = read_metrics(RunFolder(tmp_path / "seed-0").metrics)[-1]
    for written in ("return/true_return", repr(last["true_return"]), "policy.learning_rate", "final/mean"):
        assert written.encode() in content


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """The address of an MLflow server with a database of its own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    uri = f"http://127.0.0.1:{port}"
    store = ("--backend-store-uri", f"sqlite:///{tmp_path}/mlflow.db", "--artifacts-destination", str(tmp_path / "art"))
    with subprocess.Popen(
        [MLFLOW_SERVER, "server", "--port", str(port), "--workers", "1", *store],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as process:
        try:
            until(lambda: process.poll() is not None or answers(uri), "the MLflow server")
            yield uri
        finally:
            os.killpg(process.pid, signal.SIGKILL)


def answers(uri: str) -> bool:
    try:
        with urlopen(f"{uri}/health", timeout=1) as response:
            return response.status == 200
    except OSError:
        return False


@pytest.mark.skipif(
    find_spec("mlflow") is None or not MLFLOW_SERVER.exists(), reason="mlflow is not installed (make test-loggers)"
)
def test_mlflow_gets_every_iteration_once_of_a_run_that_is_killed_and_resumed(tmp_path: Path, server: str) -> None:
    killed(tmp_path / "runs", "mlflow", MLFLOW_TRACKING_URI=server)
    train(tmp_path / "runs", "mlflow", MLFLOW_TRACKING_URI=server)
    client = import_module("mlflow").MlflowClient(server)
    experiment = client.get_experiment_by_name("accord")
    assert experiment is not None
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.info.status == "FINISHED"
    assert run.data.params["task"] == short_tasks.SHORTEST_NAME
    lines = read_metrics(RunFolder(tmp_path / "runs" / "seed-0").metrics)
    history = client.get_metric_history(run.info.run_id, "return/learned_return")
    assert [(each.step, each.value) for each in history] == [(line["steps"], line["learned_return"]) for line in lines]
    assert "final/mean" in run.data.metrics


@pytest.mark.skipif(find_spec("mlflow") is None, reason="mlflow is not installed (make test-loggers)")
def test_a_logger_that_cannot_be_reached_does_not_stop_the_training(tmp_path: Path) -> None:
    printed = train(tmp_path, "mlflow", MLFLOW_TRACKING_URI="http://127.0.0.1:9", MLFLOW_HTTP_REQUEST_MAX_RETRIES="0")
    assert "is no longer logged to mlflow" in printed
    assert len(read_metrics(RunFolder(tmp_path / "seed-0").metrics)) == N_ITERATIONS
