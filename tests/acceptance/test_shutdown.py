"""Shutdown of `accord up`: no process is left."""

import signal

import pytest

from acceptance.accord_service import Accord, Client, alive
from support.waiting import PATIENCE_SECONDS, until


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_one_signal_ends_all_processes_and_saves_a_checkpoint(accord: Accord, number: signal.Signals) -> None:
    accord.start()
    client = Client(accord, accord.token("ada", "researcher"))
    client.create_experiment(reward_source="true", total_steps=10_000_000)
    until(lambda: accord.rows("SELECT 1 FROM metrics WHERE name = 'learned_return'"), "training has begun")
    processes = list(until(accord.all_ready, "all processes handle signals").values())
    accord.send_signal(number)
    assert accord.supervisor.wait(PATIENCE_SECONDS) == 0
    until(lambda: not any(alive(process) for process in processes), "all have ended")
    assert accord.rows("SELECT 1 FROM policy_checkpoints"), "the policy stored no checkpoint"
    assert accord.rows("SELECT DISTINCT state FROM workers") == [("stopped",)]
    assert not (accord.home / "url").exists()


def test_a_worker_that_does_not_respond_is_killed(accord: Accord) -> None:
    accord.start()
    processes = until(accord.all_ready, "all processes handle signals")
    processes["policy"].suspend()
    accord.send_signal()
    assert accord.supervisor.wait(PATIENCE_SECONDS) == 0
    assert "killed: policy-0" in accord.log.read_text()
    until(lambda: not any(alive(process) for process in processes.values()), "all have ended")


def test_a_second_signal_kills_all_processes_at_once(accord: Accord) -> None:
    accord.start()
    processes = until(accord.all_ready, "all processes handle signals")
    for process in processes.values():
        process.suspend()
    accord.send_signal(signal.SIGINT)
    until(lambda: "stopping" in accord.log.read_text(), "the supervisor waits for its children")
    accord.send_signal(signal.SIGINT)
    accord.supervisor.wait(PATIENCE_SECONDS)
    until(lambda: not any(alive(process) for process in processes.values()), "all have ended")
    killed = accord.log.read_text().rpartition("killed: ")[2].split()
    assert {name.strip(",") for name in killed} == {"api", "policy-0", "reward-0", "render-0"}
