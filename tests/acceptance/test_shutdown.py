"""The end of `accord up`: nothing stays behind."""

import signal

import pytest

from acceptance.accord_service import Accord, Person, alive
from support.waiting import PATIENCE_SECONDS, until


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_one_signal_ends_all_processes_in_good_order(accord: Accord, number: signal.Signals) -> None:
    accord.start()
    person = Person(accord, accord.token("ada", "researcher"))
    person.begin(reward_source="true", total_steps=10_000_000)
    until(lambda: accord.rows("SELECT 1 FROM metrics WHERE name = 'learned_return'"), "training has begun")
    family = list(until(accord.all_listening, "all processes listen").values())
    accord.ask_to_end(number)
    assert accord.supervisor.wait(PATIENCE_SECONDS) == 0
    until(lambda: not any(alive(process) for process in family), "all have ended")
    assert accord.rows("SELECT 1 FROM policy_checkpoints"), "the policy left without a checkpoint"
    assert accord.rows("SELECT DISTINCT state FROM workers") == [("stopped",)]
    assert not (accord.home / "url").exists()


def test_a_worker_that_does_not_listen_is_killed_in_the_end(accord: Accord) -> None:
    accord.start()
    family = until(accord.all_listening, "all processes listen")
    family["policy"].suspend()
    accord.ask_to_end()
    assert accord.supervisor.wait(PATIENCE_SECONDS) == 0
    assert "killed: policy-0" in accord.log.read_text()
    until(lambda: not any(alive(process) for process in family.values()), "all have ended")


def test_asked_twice_it_waits_for_nobody(accord: Accord) -> None:
    accord.start()
    family = until(accord.all_listening, "all processes listen")
    for process in family.values():
        process.suspend()
    accord.ask_to_end(signal.SIGINT)
    until(lambda: "stopping" in accord.log.read_text(), "it waits for its children")
    accord.ask_to_end(signal.SIGINT)
    accord.supervisor.wait(PATIENCE_SECONDS)
    until(lambda: not any(alive(process) for process in family.values()), "all have ended")
    killed = accord.log.read_text().rpartition("killed: ")[2].split()
    assert {name.strip(",") for name in killed} == {"api", "policy-0", "reward-0", "render-0"}
