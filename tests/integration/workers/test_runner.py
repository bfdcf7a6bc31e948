from pathlib import Path

import pytest

from accord.domain.enums import WorkerRole
from accord.workers.heartbeat import Heartbeat
from accord.workers.runner import Context, run_loop
from integration.workers.workplace import Workplace, workplace
from support.waiting import until


class FailsTwice:
    """Fails twice, works once, then asks the process to end."""

    def __init__(self, place: Workplace) -> None:
        self._place = place
        self.tries = 0
        self.seen: list[tuple[str, str]] = []

    def row(self) -> tuple[str, str]:
        [row] = self._place.rows("SELECT state, detail FROM workers")
        return row

    def work(self) -> bool:
        self.tries += 1
        if self.tries > 1:
            until(lambda: self.row()[0] == ("backing_off" if self.tries < 4 else "working"))
            self.seen.append(self.row())
        if self.tries < 3:
            raise RuntimeError("the cable is loose\nand more")
        if self.tries == 3:
            self._place.context.heartbeat.set_state("working", "on it")
            return True
        self._place.context.stop.request()
        return False

    def close(self) -> None:
        pass


def test_a_failure_is_reported_and_retried_after_a_pause(place: Workplace):
    worker = FailsTwice(place)
    run_loop(place.context, worker)
    assert worker.tries == 4
    assert [state for state, _ in worker.seen] == ["backing_off", "backing_off", "working"]
    assert worker.seen[0][1].startswith("RuntimeError: the cable is loose. Retrying in")


def test_the_row_of_an_ended_worker_says_stopped(tmp_path: Path):
    with workplace(tmp_path) as place:
        place.context.heartbeat.set_state("working", "hard")
    assert place.rows("SELECT state FROM workers") == [("stopped",)]


def second(context: Context) -> Heartbeat:
    return Heartbeat(context.database, "policy-1", WorkerRole.POLICY, "second", context.settings.worker_lease_seconds)


def test_one_worker_at_a_time_holds_a_claim(place: Workplace):
    with place.context.heartbeat.claim("policy:exp_1") as mine:
        assert mine is not None
        with second(place.context).claim("policy:exp_1") as theirs:
            assert theirs is None
    with second(place.context).claim("policy:exp_1") as theirs:
        assert theirs is not None


def test_the_heartbeat_notices_a_lost_claim(tmp_path: Path):
    with workplace(tmp_path) as place:
        heartbeat = Heartbeat(place.database, "policy-2", WorkerRole.POLICY, "third", 0.4)
        heartbeat.start()
        with heartbeat.claim("policy:exp_1") as claim:
            assert claim is not None
            until(lambda: claim.confirmed_at and not claim.lost)
            with place.database.transaction() as session:
                session.connection().exec_driver_sql("UPDATE claims SET holder = 'another'")
            until(lambda: claim.lost)
        heartbeat.close()


def test_heartbeats_extend_the_lease(tmp_path: Path):
    with workplace(tmp_path) as place:
        heartbeat = Heartbeat(place.database, "policy-2", WorkerRole.POLICY, "third", 0.4)
        heartbeat.start()
        with heartbeat.claim("policy:exp_1") as claim:
            assert claim is not None
            taken_at = claim.confirmed_at
            until(lambda: claim.confirmed_at > taken_at + 1.0)
            with pytest.raises(AssertionError), second(place.context).claim("policy:exp_1") as theirs:
                assert theirs is not None
        heartbeat.close()
