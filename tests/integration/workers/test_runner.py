from pathlib import Path

import pytest

from accord.domain.enums import WorkerRole
from accord.workers.heartbeat import Heartbeat
from accord.workers.runner import Context, run_loop
from integration.workers.workplace import Workplace, workplace
from support.waiting import until


class Moody:
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


def test_a_failure_is_recorded_left_alone_and_tried_again(place: Workplace):
    worker = Moody(place)
    run_loop(place.context, worker)
    assert worker.tries == 4
    assert [state for state, _ in worker.seen] == ["backing_off", "backing_off", "working"]
    assert worker.seen[0][1].startswith("RuntimeError: the cable is loose. Retrying in")


def test_the_row_says_stopped_in_the_end(tmp_path: Path):
    with workplace(tmp_path) as place:
        place.context.heartbeat.set_state("working", "hard")
    assert place.rows("SELECT state FROM workers") == [("stopped",)]


def second(context: Context) -> Heartbeat:
    return Heartbeat(context.database, "policy-1", WorkerRole.POLICY, "second", context.settings.worker_lease_seconds)


def test_a_claim_is_one_workers_at_a_time(place: Workplace):
    with place.context.heartbeat.claim("policy:exp_1") as mine:
        assert mine is not None
        with second(place.context).claim("policy:exp_1") as theirs:
            assert theirs is None
    with second(place.context).claim("policy:exp_1") as theirs:
        assert theirs is not None


def test_a_claim_that_was_taken_over_is_noticed_without_asking(tmp_path: Path):
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


def test_heartbeats_outlast_the_lease(tmp_path: Path):
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
