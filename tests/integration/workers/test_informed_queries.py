"""Queries that an ensemble of the newest reward version selects."""

import os
import sqlite3
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load

from accord.services import label
from accord.workers.policy_run import PolicyRun
from accord.workers.reward_worker import RewardWorker
from accord.workers.runner import Stop
from integration.workers.worker_harness import STEPS_PER_ITERATION, SingleThreadedRewardWorker, WorkerHarness
from support.waiting import until

pytestmark = pytest.mark.slow

SETTINGS: dict[str, Any] = {
    "query_selection": "disagreement",
    "control_share": 0.25,
    "ensemble_members": 2,
    "label_budget": 60,
    "lookahead_queries": 2,
}


@dataclass(slots=True)
class RunningExperiment:
    """An experiment and the run of its policy."""

    harness: WorkerHarness
    id: str
    run: PolicyRun

    def worker(self) -> SingleThreadedRewardWorker:
        return SingleThreadedRewardWorker(self.harness.context)

    def train_policy(self) -> None:
        """Run one more iteration, which stores segments and makes more labels due."""
        before = self.steps()
        while self.steps() == before:
            assert self.run.step()
        # until the next rollout is stored and the policy waits for labels
        while self.run.step():
            pass

    def steps(self) -> int:
        return self.harness.rows("SELECT steps FROM experiments WHERE id = ?", self.id)[0][0]

    def queries(self) -> list[tuple[str, str | None, str, str]]:
        """(selector, reward version, segment 0, segment 1) of the queries, in order of creation."""
        return self.harness.rows(
            "SELECT selector, reward_version_id, segment_0_id, segment_1_id FROM queries ORDER BY number"
        )

    def version_id(self, number: int) -> str:
        return self.harness.rows("SELECT id FROM reward_versions WHERE number = ?", number)[0][0]

    def ensembles(self) -> list[Path]:
        return sorted((self.harness.home / "blobs").rglob("*.ensemble.safetensors"))


def running_experiment(harness: WorkerHarness, **changes: Any) -> Iterator[RunningExperiment]:
    id = harness.create_experiment(**(SETTINGS | changes))
    with harness.training(id) as run:
        while run.step():
            pass
        yield RunningExperiment(harness, id, run)


@pytest.fixture
def experiment(harness: WorkerHarness) -> Iterator[RunningExperiment]:
    yield from running_experiment(harness)


@pytest.fixture
def with_version(experiment: RunningExperiment) -> tuple[RunningExperiment, SingleThreadedRewardWorker]:
    """An experiment with its first reward version, whose ensemble is not yet trained."""
    worker = experiment.worker()
    assert worker.work()
    experiment.harness.label(experiment.id, 8)
    assert worker.work()
    assert experiment.ensembles() == []
    return experiment, worker


def work_until_idle(worker: SingleThreadedRewardWorker) -> None:
    while worker.work():
        pass


def test_queries_after_the_first_version_are_selected_by_disagreement_with_a_uniform_share(with_version):
    experiment, worker = with_version
    work_until_idle(worker)
    experiment.train_policy()
    work_until_idle(worker)
    first, later = experiment.queries()[:10], experiment.queries()[10:]
    assert {query[:2] for query in first} == {("uniform", None)}
    assert len(later) > 12
    assert {query[:2] for query in later} == {("uniform", None), ("disagreement", experiment.version_id(1))}
    uniform = Counter(query[0] for query in later)["uniform"]
    # the nearest whole number to a quarter
    assert abs(uniform - 0.25 * len(later)) < 1
    pairs = {frozenset(query[2:]) for query in experiment.queries()}
    assert len(pairs) == len(experiment.queries())


def test_queries_are_uniform_until_an_ensemble_is_trained(with_version):
    experiment, worker = with_version
    experiment.train_policy()
    assert worker.work()
    assert {query[:2] for query in experiment.queries()} == {("uniform", None)}
    assert len(experiment.queries()) > 22
    assert len(experiment.ensembles()) == 1


def test_the_parents_ensemble_is_used_until_the_newest_version_has_one(with_version):
    experiment, worker = with_version
    work_until_idle(worker)
    experiment.train_policy()
    work_until_idle(worker)
    experiment.harness.label(experiment.id, len(experiment.queries()) - 8)
    # trains only version 2
    assert worker.work()
    n_queries = len(experiment.queries())
    experiment.train_policy()
    assert worker.work()
    assert {query[:2] for query in experiment.queries()[n_queries:]} == {
        ("uniform", None),
        ("disagreement", experiment.version_id(1)),
    }
    assert len(experiment.ensembles()) == 2


def test_a_restarted_worker_selects_the_same_pairs(with_version):
    experiment, worker = with_version
    work_until_idle(worker)
    experiment.train_policy()
    n_queries = len(experiment.queries())
    work_until_idle(worker)
    chosen = experiment.queries()[n_queries:]
    assert chosen
    with experiment.harness.database.transaction() as session:
        session.connection().exec_driver_sql(f"DELETE FROM queries WHERE number > {n_queries}")
    work_until_idle(experiment.worker())
    assert experiment.queries()[n_queries:] == chosen


def test_a_damaged_ensemble_is_not_used_and_is_trained_again(with_version):
    experiment, worker = with_version
    work_until_idle(worker)
    (path,) = experiment.ensembles()
    whole = path.read_bytes()
    path.write_bytes(whole[:-40])
    experiment.train_policy()
    work_until_idle(experiment.worker())
    assert {query[0] for query in experiment.queries()} == {"uniform"}
    retrained, original = load(path.read_bytes()), load(whole)
    assert all(np.array_equal(retrained[name], original[name]) for name in original)


def test_a_stop_while_an_ensemble_trains_stores_nothing(with_version):
    experiment, worker = with_version
    experiment.harness.context.stop.request()
    assert not worker.work()
    assert experiment.ensembles() == []


def test_no_ensemble_is_trained_after_the_last_query(harness: WorkerHarness):
    for experiment in running_experiment(harness, label_budget=10):
        worker = experiment.worker()
        assert worker.work()
        skipped, *_ = [query_id for (query_id,) in harness.rows("SELECT id FROM queries ORDER BY number DESC")]
        harness.label(experiment.id, 8)
        work_until_idle(worker)
        assert experiment.version_id(1)
        assert experiment.ensembles() == []
        # a skipped query is replaced at once
        with harness.database.transaction() as session:
            label.put_label(session, harness.teacher, skipped, None)
        work_until_idle(worker)
        assert len(experiment.queries()) == 11
        assert experiment.ensembles() == []


class WaitsForQueries(Stop):
    """A `Stop` that, when first read during training, makes queries due and waits for the planner to create them."""

    def __init__(self, experiment: RunningExperiment) -> None:
        super().__init__()
        self._experiment = experiment
        self._before = len(experiment.queries())
        self.was_read = False

    @property
    def requested(self) -> bool:
        # The planner's thread reads this too, and must not wait for itself.
        if threading.current_thread() is threading.main_thread() and not self.was_read:
            self.was_read = True
            with (
                closing(sqlite3.connect(self._experiment.harness.home / "accord.db", timeout=20)) as connection,
                connection,
            ):
                connection.execute("UPDATE experiments SET steps = ?", (STEPS_PER_ITERATION,))
            until(lambda: len(self._experiment.queries()) > self._before)
        return super().requested


@pytest.mark.parametrize("trained", ["version", "ensemble"])
def test_queries_that_become_due_during_training_are_created_before_it_ends(
    experiment: RunningExperiment, trained: str
):
    worker = experiment.worker()
    assert worker.work()
    experiment.harness.label(experiment.id, 8)
    if trained == "ensemble":
        assert worker.work()
    stop = WaitsForQueries(experiment)
    trainer = RewardWorker(replace(experiment.harness.context, stop=stop))
    trainer.start_threads()
    try:
        assert trainer.work()
    finally:
        stop.request()
        trainer.close()
        stop.close()
    assert stop.was_read


def test_k_center_selection_trains_no_ensemble(harness: WorkerHarness):
    for experiment in running_experiment(harness, query_selection="k_center"):
        worker = experiment.worker()
        assert worker.work()
        harness.label(experiment.id, 8)
        work_until_idle(worker)
        experiment.train_policy()
        work_until_idle(worker)
        assert {query[:2] for query in experiment.queries()[10:]} == {("uniform", None), ("k_center", None)}
        assert experiment.ensembles() == []


def test_entropy_k_center_selection_uses_the_newest_version(harness: WorkerHarness):
    for experiment in running_experiment(harness, query_selection="entropy_k_center", control_share=0.0):
        worker = experiment.worker()
        assert worker.work()
        harness.label(experiment.id, 8)
        work_until_idle(worker)
        experiment.train_policy()
        work_until_idle(worker)
        assert {query[:2] for query in experiment.queries()[10:]} == {("entropy_k_center", experiment.version_id(1))}


@pytest.fixture
def start(experiment: RunningExperiment) -> Iterator[Any]:
    """A function that starts a reward worker as a process. All are killed at the end of the test."""
    processes: list[subprocess.Popen[bytes]] = []
    environment = {
        "ACCORD_HOME": str(experiment.harness.home),
        "ACCORD_POLL_SECONDS": "0.02",
        "ACCORD_WORKER_LEASE_SECONDS": "2",
        "ACCORD_TORCH_THREADS": "1",
        "ACCORD_REWARD_PROCESSES": "2",
    }

    def start_process() -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "accord.start", "accord.workers.reward_worker", "--parent", str(os.getpid())]
        processes.append(subprocess.Popen(command, env=os.environ | environment))
        return processes[-1]

    yield start_process
    for process in processes:
        process.kill()
        process.wait()


def test_a_worker_killed_between_a_version_and_its_ensemble_resumes(experiment: RunningExperiment, start: Any):
    harness = experiment.harness
    with harness.database.transaction() as session:
        # training four members takes long enough to see the version before the ensemble is stored
        session.connection().exec_driver_sql(
            "UPDATE experiments SET config = json_set(config, '$.ensemble_members', 4)"
        )
    worker = start()
    until(lambda: len(experiment.queries()) == 10)
    harness.label(experiment.id, 8)
    until(lambda: harness.rows("SELECT 1 FROM reward_versions"))
    worker.kill()
    worker.wait()
    assert experiment.ensembles() == []
    experiment.train_policy()
    start()
    until(experiment.ensembles)
    assert harness.rows("SELECT number FROM reward_versions") == [(1,)]
    # The planner may add these queries after the ensemble is stored. Until then two queries are open, whose labels are
    # too few for the next version.
    until(lambda: len(experiment.queries()) == 28, "the queries due after one iteration, and two ahead")
    labelled = harness.label(experiment.id, 20)
    until(lambda: harness.rows("SELECT 1 FROM reward_versions WHERE number = 2"), "the second version")
    experiment.train_policy()
    until(lambda: "disagreement" in {query[0] for query in experiment.queries()}, "queries selected by the ensemble")
    assert harness.rows("SELECT max(label_count) FROM reward_versions") == [(8 + len(labelled),)]
