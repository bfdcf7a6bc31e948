"""Workers that find nothing to do only read: SQLite has one writer at a time, and nobody waits for a poll."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from accord.domain.enums import WorkerRole
from accord.workers.policy_worker import PolicyWorker
from accord.workers.render_worker import RenderWorker
from accord.workers.runner import Context, Worker
from integration.workers.worker_harness import SingleThreadedRewardWorker, open_harness


def reward_inspector(context: Context) -> Worker:
    return SingleThreadedRewardWorker(context).inspector


@pytest.mark.parametrize(
    ("role", "make"),
    [
        (WorkerRole.POLICY, PolicyWorker),
        (WorkerRole.REWARD, SingleThreadedRewardWorker),
        (WorkerRole.REWARD, reward_inspector),
        (WorkerRole.RENDER, RenderWorker),
    ],
)
def test_an_idle_worker_polls_while_another_process_holds_the_write_lock(tmp_path: Path, role, make):
    with open_harness(tmp_path, role) as harness:
        harness.create_experiment()
        worker = make(harness.context)
        with harness.database.transaction() as session:
            session.connection().exec_driver_sql("UPDATE experiments SET status = 'finished'")
        with closing(sqlite3.connect(tmp_path / "accord.db", isolation_level=None, timeout=20)) as other:
            other.execute("BEGIN IMMEDIATE")
            # Waiting for the lock ends with DatabaseUnreachable.
            assert not worker.work()
            other.execute("ROLLBACK")
        worker.close()
