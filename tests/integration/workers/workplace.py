"""The surroundings of a worker in the test's own process: a migrated database, blobs, a heartbeat."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from accord.domain.enums import Role, WorkerRole
from accord.services import accounts, experiments, label
from accord.services.experiment_config import ExperimentConfig
from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database
from accord.store.tables import UserRow
from accord.workers.heartbeat import Claim, Heartbeat
from accord.workers.policy_run import PolicyRun
from accord.workers.render_worker import RenderWorker
from accord.workers.reward_worker import RewardWorker
from accord.workers.runner import Context, Stop
from support import short_tasks

STEPS_PER_ITERATION = 100
TINY: dict[str, Any] = {
    "task": short_tasks.NAME,
    "segment_steps": 10,
    "total_steps": 6 * STEPS_PER_ITERATION,
    "label_budget": 16,
    "initial_labels": 8,
    "labels_per_version": 4,
    "render_clips": False,
    "policy": {"n_envs": 4, "rollout_steps": 25, "epochs": 2, "minibatches": 2},
}


class SingleThreadedRewardWorker(RewardWorker):
    """The reward worker without its planner's thread: each call of `work` creates queries, then trains."""

    def work(self) -> bool:
        planned = self.planner.work()
        return super().work() or planned


@dataclass(slots=True)
class Workplace:
    """One home and one worker's context."""

    home: Path
    context: Context
    teacher: UserRow

    @property
    def database(self) -> Database:
        return self.context.database

    def begin(self, name: str = "tiny", **changes: Any) -> str:
        """A new experiment; returns its id."""
        config = ExperimentConfig(**{**TINY, **changes})
        with self.database.transaction() as session:
            return experiments.create(session, self.teacher.id, name, config, None).id

    @contextmanager
    def training(self, id: str) -> Iterator[PolicyRun]:
        """A policy's run under its claim, as after the start of a process."""
        with self.database.reading() as session:
            config = experiments.config_of(experiments.get(session, id))
        with self.context.heartbeat.claim(f"policy:{id}") as claim:
            assert isinstance(claim, Claim)
            run = PolicyRun(self.context, id, config, claim)
            try:
                yield run
            finally:
                run.close()

    def train(self, id: str) -> None:
        """Let the policy go on as far as labels allow."""
        with self.training(id) as run:
            while run.step():
                pass

    def make_clips(self) -> None:
        """Make every clip that is asked for."""
        worker = RenderWorker(self.context)
        try:
            while worker.work():
                pass
        finally:
            worker.close()

    def label(self, id: str, count: int, value: float | None = None) -> list[str]:
        """Label the first `count` open queries, by true return or all alike; returns their ids."""
        found = self.rows(
            "SELECT q.id, a.true_return > b.true_return FROM queries q"
            " JOIN segments a ON a.id = q.segment_0_id JOIN segments b ON b.id = q.segment_1_id"
            " WHERE q.experiment_id = ? AND q.status = 'open' ORDER BY q.number LIMIT ?",
            id,
            count,
        )
        assert len(found) == count
        with self.database.transaction() as session:
            for query_id, better in found:
                label.put_label(session, self.teacher, query_id, float(better) if value is None else value)
        return [query_id for query_id, _ in found]

    def relabel(self, query_ids: list[str], value: float) -> None:
        with self.database.transaction() as session:
            for query_id in query_ids:
                label.put_label(session, self.teacher, query_id, value)

    def rows(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        with closing(sqlite3.connect(self.home / "accord.db", timeout=20)) as connection:
            return connection.execute(statement, values).fetchall()

    def curve(self, id: str, name: str) -> dict[int, float]:
        return dict(
            self.rows("SELECT step, value FROM metrics WHERE experiment_id = ? AND name = ? ORDER BY step", id, name)
        )


@contextmanager
def workplace(home: Path, role: WorkerRole = WorkerRole.POLICY) -> Iterator[Workplace]:
    """Opened over a fresh home, closed at the end of the block."""
    settings = Settings(home=home, torch_threads=1, poll_seconds=0.01, worker_lease_seconds=30.0)
    database = Database.open(settings.resolved_database_url)
    database.migrate()
    with database.transaction() as session:
        teacher, _ = accounts.create_user(session, "oracle", Role.TEACHER)
    heartbeat = Heartbeat(database, f"{role.value}-0", role, "holder", settings.worker_lease_seconds)
    heartbeat.start()
    context = Context(settings, database, open_blobs(settings.resolved_blob_url), heartbeat, Stop(), "holder")
    try:
        yield Workplace(home, context, teacher)
    finally:
        heartbeat.close()
        context.stop.close()
        database.close()
