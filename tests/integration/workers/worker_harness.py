"""What a worker needs to run in the process of the test: a migrated database, blobs and a heartbeat."""

import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from accord.domain.enums import Role, WorkerRole
from accord.services import accounts, experiments, initial_policies, label
from accord.services.experiment_config import ExperimentConfig
from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database
from accord.store.migrate import migrate
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
    "pacing": "wait",
    "render_clips": False,
    "policy": {"n_envs": 4, "rollout_steps": 25, "epochs": 2, "minibatches": 2},
}


class SingleThreadedRewardWorker(RewardWorker):
    """A reward worker without the thread of its query planner: `work` creates queries, then trains."""

    def work(self) -> bool:
        planned = self.planner.work()
        return super().work() or planned


@dataclass(slots=True)
class WorkerHarness:
    """A home folder, the context of a worker, and a teacher."""

    home: Path
    context: Context
    teacher: UserRow

    @property
    def database(self) -> Database:
        return self.context.database

    def create_experiment(self, name: str = "tiny", **changes: Any) -> str:
        """Create a tiny experiment; `changes` override fields of its configuration. Returns its id."""
        config, blobs = ExperimentConfig(**{**TINY, **changes}), self.context.blobs
        with ExitStack() as stack:
            initial = None
            if config.initial_policy:
                with self.database.reading() as session:
                    key = initial_policies.blob_key(session, config.initial_policy)
                initial = stack.enter_context(initial_policies.copied(blobs, key))
            session = stack.enter_context(self.database.transaction())
            return experiments.create(session, self.teacher.id, name, config, None, initial=initial).id

    @contextmanager
    def training(self, id: str) -> Iterator[PolicyRun]:
        """The run of the experiment's policy, opened under a claim as a policy worker does."""
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
        """Train the policy until it finishes or waits for labels."""
        with self.training(id) as run:
            while run.step():
                pass

    def render_clips(self) -> None:
        """Render every requested clip."""
        worker = RenderWorker(self.context)
        try:
            while worker.work():
                pass
        finally:
            worker.close()

    def label(self, id: str, count: int, value: float | None = None, by: UserRow | None = None) -> list[str]:
        """Label the first `count` open queries with `value`, or by true return if it is None. Returns their ids.

        Args:
            by: who labels, the harness's teacher by default.
        """
        queries = self.rows(
            "SELECT q.id, a.true_return > b.true_return FROM queries q"
            " JOIN segments a ON a.id = q.segment_0_id JOIN segments b ON b.id = q.segment_1_id"
            " WHERE q.experiment_id = ? AND q.status = 'open' ORDER BY q.number LIMIT ?",
            id,
            count,
        )
        assert len(queries) == count
        with self.database.transaction() as session:
            for query_id, better in queries:
                label.put_label(session, by or self.teacher, query_id, float(better) if value is None else value)
        return [query_id for query_id, _ in queries]

    def relabel(self, query_ids: list[str], value: float) -> None:
        with self.database.transaction() as session:
            for query_id in query_ids:
                label.put_label(session, self.teacher, query_id, value)

    def rows(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        """Rows of the database, read over a separate connection."""
        with closing(sqlite3.connect(self.home / "accord.db", timeout=20)) as connection:
            return connection.execute(statement, values).fetchall()

    def curve(self, id: str, name: str) -> dict[int, float]:
        """The values of a metric by step."""
        return dict(
            self.rows("SELECT step, value FROM metrics WHERE experiment_id = ? AND name = ? ORDER BY step", id, name)
        )


@contextmanager
def open_harness(home: Path, role: WorkerRole = WorkerRole.POLICY) -> Iterator[WorkerHarness]:
    """A harness with a new home folder, closed at the end of the block."""
    settings = Settings(home=home, torch_threads=1, poll_seconds=0.01, worker_lease_seconds=30.0, clip_width=320)
    database = Database.open(settings.resolved_database_url)
    migrate(database)
    with database.transaction() as session:
        teacher, _ = accounts.create_user(session, "oracle", Role.TEACHER)
    heartbeat = Heartbeat(database, f"{role.value}-0", role, "holder", settings.worker_lease_seconds)
    heartbeat.start()
    context = Context(settings, database, open_blobs(settings.resolved_blob_url), heartbeat, Stop(), "holder")
    try:
        yield WorkerHarness(home, context, teacher)
    finally:
        heartbeat.close()
        context.stop.close()
        database.close()
