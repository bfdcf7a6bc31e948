"""Queries chosen by an ensemble of the newest reward version, with the real worker."""

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
from integration.workers.workplace import STEPS_PER_ITERATION, SingleThreadedRewardWorker, Workplace
from support.waiting import until

SETTINGS: dict[str, Any] = {
    "query_selection": "disagreement",
    "control_share": 0.25,
    "ensemble_members": 2,
    "label_budget": 60,
    "lookahead_queries": 2,
}


@dataclass(slots=True)
class Bench:
    """An experiment with its policy's run."""

    place: Workplace
    id: str
    run: PolicyRun

    def worker(self) -> SingleThreadedRewardWorker:
        return SingleThreadedRewardWorker(self.place.context)

    def train_policy(self) -> None:
        """One more iteration, whose segments join the pool and which makes more labels due."""
        before = self.steps()
        while self.steps() == before:
            assert self.run.step()
        # the next rollout is handed in by now, and waits
        while self.run.step():
            pass

    def steps(self) -> int:
        return self.place.rows("SELECT steps FROM experiments WHERE id = ?", self.id)[0][0]

    def queries(self) -> list[tuple[str, str | None, str, str]]:
        """(selector, reward version, segments) in their order."""
        return self.place.rows(
            "SELECT selector, reward_version_id, segment_0_id, segment_1_id FROM queries ORDER BY number"
        )

    def version_id(self, number: int) -> str:
        return self.place.rows("SELECT id FROM reward_versions WHERE number = ?", number)[0][0]

    def ensembles(self) -> list[Path]:
        return sorted((self.place.home / "blobs").rglob("*.ensemble.safetensors"))


def bench_of(place: Workplace, **changes: Any) -> Iterator[Bench]:
    id = place.begin(**(SETTINGS | changes))
    with place.training(id) as run:
        while run.step():
            pass
        yield Bench(place, id, run)


@pytest.fixture
def bench(place: Workplace) -> Iterator[Bench]:
    yield from bench_of(place)


@pytest.fixture
def versioned(bench: Bench) -> tuple[Bench, SingleThreadedRewardWorker]:
    """The first version is out, its ensemble is not trained."""
    worker = bench.worker()
    assert worker.work()
    bench.place.label(bench.id, 8)
    assert worker.work()
    assert bench.ensembles() == []
    return bench, worker


def drain(worker: SingleThreadedRewardWorker) -> None:
    while worker.work():
        pass


def test_after_the_first_version_queries_are_chosen_by_disagreement_and_a_share_stays_uniform(versioned):
    bench, worker = versioned
    drain(worker)
    bench.train_policy()
    drain(worker)
    first, later = bench.queries()[:10], bench.queries()[10:]
    assert {query[:2] for query in first} == {("uniform", None)}
    assert len(later) > 12
    assert {query[:2] for query in later} == {("uniform", None), ("disagreement", bench.version_id(1))}
    uniform = Counter(query[0] for query in later)["uniform"]
    # as close to a quarter as a whole number can be
    assert abs(uniform - 0.25 * len(later)) < 1
    pairs = {frozenset(query[2:]) for query in bench.queries()}
    assert len(pairs) == len(bench.queries())


def test_queries_are_uniform_until_there_is_an_ensemble(versioned):
    bench, worker = versioned
    bench.train_policy()
    assert worker.work()
    assert {query[:2] for query in bench.queries()} == {("uniform", None)}
    assert len(bench.queries()) > 22
    assert len(bench.ensembles()) == 1


def test_without_an_ensemble_of_the_newest_version_its_parents_is_used(versioned):
    bench, worker = versioned
    drain(worker)
    bench.train_policy()
    drain(worker)
    bench.place.label(bench.id, len(bench.queries()) - 8)
    # version 2, and nothing else
    assert worker.work()
    asked = len(bench.queries())
    bench.train_policy()
    assert worker.work()
    assert {query[:2] for query in bench.queries()[asked:]} == {
        ("uniform", None),
        ("disagreement", bench.version_id(1)),
    }
    assert len(bench.ensembles()) == 2


def test_a_restarted_worker_chooses_the_same_pairs(versioned):
    bench, worker = versioned
    drain(worker)
    bench.train_policy()
    asked = len(bench.queries())
    drain(worker)
    chosen = bench.queries()[asked:]
    assert chosen
    with bench.place.database.transaction() as session:
        session.connection().exec_driver_sql(f"DELETE FROM queries WHERE number > {asked}")
    drain(bench.worker())
    assert bench.queries()[asked:] == chosen


def test_a_damaged_ensemble_is_not_used_and_trained_again(versioned):
    bench, worker = versioned
    drain(worker)
    (path,) = bench.ensembles()
    whole = path.read_bytes()
    path.write_bytes(whole[:-40])
    bench.train_policy()
    drain(bench.worker())
    assert {query[0] for query in bench.queries()} == {"uniform"}
    again, before = load(path.read_bytes()), load(whole)
    assert all(np.array_equal(again[name], before[name]) for name in before)


def test_a_stop_in_the_middle_of_an_ensembles_training_stores_nothing(versioned):
    bench, worker = versioned
    bench.place.context.stop.request()
    assert not worker.work()
    assert bench.ensembles() == []


def test_no_ensemble_is_trained_once_the_last_query_is_made(place: Workplace):
    for bench in bench_of(place, label_budget=10):
        worker = bench.worker()
        assert worker.work()
        skipped, *_ = [query_id for (query_id,) in place.rows("SELECT id FROM queries ORDER BY number DESC")]
        place.label(bench.id, 8)
        drain(worker)
        assert bench.version_id(1)
        assert bench.ensembles() == []
        # a skipped query is replaced at once
        with place.database.transaction() as session:
            label.put_label(session, place.teacher, skipped, None)
        drain(worker)
        assert len(bench.queries()) == 11
        assert bench.ensembles() == []


class WaitsForQueries(Stop):
    """Asked before every gradient step, it moves the policy on, which makes queries due, and waits for them."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self._bench = bench
        self._before = len(bench.queries())
        self.was_asked = False

    @property
    def requested(self) -> bool:
        # The planner's thread asks too, and must not wait for itself.
        if threading.current_thread() is threading.main_thread() and not self.was_asked:
            self.was_asked = True
            with closing(sqlite3.connect(self._bench.place.home / "accord.db", timeout=20)) as connection, connection:
                connection.execute("UPDATE experiments SET steps = ?", (STEPS_PER_ITERATION,))
            until(lambda: len(self._bench.queries()) > self._before)
        return super().requested


@pytest.mark.parametrize("what", ["version", "ensemble"])
def test_queries_that_become_due_during_a_training_do_not_wait_for_its_end(bench: Bench, what: str):
    worker = bench.worker()
    assert worker.work()
    bench.place.label(bench.id, 8)
    if what == "ensemble":
        assert worker.work()
    stop = WaitsForQueries(bench)
    trainer = RewardWorker(replace(bench.place.context, stop=stop))
    trainer.start_planner()
    try:
        assert trainer.work()
    finally:
        stop.request()
        trainer.close()
        stop.close()
    assert stop.was_asked


def test_k_center_needs_no_ensemble(place: Workplace):
    for bench in bench_of(place, query_selection="k_center"):
        worker = bench.worker()
        assert worker.work()
        place.label(bench.id, 8)
        drain(worker)
        bench.train_policy()
        drain(worker)
        assert {query[:2] for query in bench.queries()[10:]} == {("uniform", None), ("k_center", None)}
        assert bench.ensembles() == []


def test_entropy_then_k_center(place: Workplace):
    for bench in bench_of(place, query_selection="entropy_k_center", control_share=0.0):
        worker = bench.worker()
        assert worker.work()
        place.label(bench.id, 8)
        drain(worker)
        bench.train_policy()
        drain(worker)
        assert {query[:2] for query in bench.queries()[10:]} == {("entropy_k_center", bench.version_id(1))}


@pytest.fixture
def start(bench: Bench) -> Iterator[Any]:
    """Starts the worker's own process; whatever lives at the end is killed."""
    processes: list[subprocess.Popen[bytes]] = []
    environment = {
        "ACCORD_HOME": str(bench.place.home),
        "ACCORD_POLL_SECONDS": "0.02",
        "ACCORD_WORKER_LEASE_SECONDS": "2",
        "ACCORD_TORCH_THREADS": "1",
    }

    def begin() -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "accord.workers.reward_worker", "--parent", str(os.getpid())]
        processes.append(subprocess.Popen(command, env=os.environ | environment))
        return processes[-1]

    yield begin
    for process in processes:
        process.kill()
        process.wait()


def test_a_kill_between_a_version_and_its_ensemble_loses_nothing(bench: Bench, start: Any):
    place = bench.place
    with place.database.transaction() as session:
        # an ensemble that takes longer to train than a row to be seen
        session.connection().exec_driver_sql(
            "UPDATE experiments SET config = json_set(config, '$.ensemble_members', 4)"
        )
    worker = start()
    until(lambda: len(bench.queries()) == 10)
    place.label(bench.id, 8)
    until(lambda: place.rows("SELECT 1 FROM reward_versions"))
    worker.kill()
    worker.wait()
    assert bench.ensembles() == []
    bench.train_policy()
    start()
    until(bench.ensembles)
    assert place.rows("SELECT number FROM reward_versions") == [(1,)]
    before = len(bench.queries())
    labelled = place.label(bench.id, before - 8)
    until(lambda: place.rows("SELECT 1 FROM reward_versions WHERE number = 2"))
    bench.train_policy()
    until(lambda: "disagreement" in {query[0] for query in bench.queries()})
    assert place.rows("SELECT max(label_count) FROM reward_versions") == [(8 + len(labelled),)]
