"""Shutdown of `accord up`: no process is left."""

import signal
import sqlite3
from collections.abc import Collection
from contextlib import closing

import psutil
import pytest

from acceptance.accord_service import Accord, Client, alive
from support.waiting import PATIENCE_SECONDS, until

pytestmark = pytest.mark.slow


def start_training(accord: Accord, without: Collection[str] = ()) -> None:
    """Start the service and wait until its policy trains."""
    accord.start(without=without)
    client = Client(accord, accord.token("ada", "researcher"))
    client.create_experiment(reward_source="true", total_steps=10_000_000)
    until(lambda: accord.rows("SELECT 1 FROM metrics WHERE name = 'learned_return'"), "training has begun")


def assert_stopped(accord: Accord, *, killed: set[str]) -> None:
    """The service has ended with status 0, a checkpoint and the state `stopped` of each worker that was not killed."""
    assert accord.supervisor.wait(PATIENCE_SECONDS) == 0
    assert accord.rows("SELECT 1 FROM policy_checkpoints"), "the policy stored no checkpoint"
    states = dict(accord.rows("SELECT id, state FROM workers"))
    assert {id for id, state in states.items() if state != "stopped"} == killed
    assert not (accord.home / "url").exists()


def suspended(accord: Accord, process: psutil.Process) -> bool:
    """Suspend a process unless it holds SQLite's lock, for which the others would wait. Returns whether it is."""
    process.suspend()
    with closing(sqlite3.connect(accord.home / "accord.db", timeout=2.0)) as connection:
        try:
            connection.execute("BEGIN IMMEDIATE")
        except sqlite3.OperationalError:
            process.resume()
            return False
    return True


def assert_private(accord: Accord) -> None:
    """Everything that the service has written is for its user only."""
    assert [path for path in accord.home.rglob("*") if path.stat().st_mode & 0o077] == []
    assert any(path.suffix == ".safetensors" for path in accord.home.rglob("*"))


def test_one_signal_ends_all_processes_and_saves_a_checkpoint(accord: Accord) -> None:
    start_training(accord)
    processes = until(accord.all_ready, "all processes handle signals")
    accord.send_signal(signal.SIGINT)
    assert_stopped(accord, killed=set())
    assert "killed:" not in accord.log.read_text()
    assert_private(accord)
    until(lambda: not any(alive(process) for process in processes.values()), "all have ended")


def test_a_worker_that_does_not_respond_is_killed_and_the_others_save_their_work(accord: Accord) -> None:
    start_training(accord, without=["reward"])
    processes = until(accord.all_ready, "all processes handle signals")
    until(lambda: suspended(accord, processes["render"]), "the render worker is suspended outside a transaction")
    accord.send_signal(signal.SIGTERM)
    assert_stopped(accord, killed={"render-0"})
    assert "killed: render-0\n" in accord.log.read_text()
    until(lambda: not any(alive(process) for process in processes.values()), "all have ended")


def test_a_second_signal_kills_all_processes_at_once(accord: Accord) -> None:
    accord.start(without=["policy"])
    processes = until(accord.all_ready, "all processes handle signals")
    for process in processes.values():
        process.suspend()
    accord.send_signal(signal.SIGINT)
    until(lambda: "stopping" in accord.log.read_text(), "the supervisor waits for its children")
    accord.send_signal(signal.SIGINT)
    accord.supervisor.wait(PATIENCE_SECONDS)
    until(lambda: not any(alive(process) for process in processes.values()), "all have ended")
    killed = accord.log.read_text().rpartition("killed: ")[2].split()
    assert {name.strip(",") for name in killed} == {"api", "reward-0", "render-0"}
