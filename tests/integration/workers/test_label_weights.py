"""Labels of several people are weighted by their estimated reliability, before each reward version."""

from typing import Any

import pytest

from accord.domain.enums import Role
from accord.services import accounts, label, publish
from accord.store.tables import UserRow
from accord.workers.label_weights import weight_labels, weights_of_version
from accord.workers.reward_worker import SegmentCache
from integration.workers.worker_harness import SingleThreadedRewardWorker, WorkerHarness

SETTINGS: dict[str, Any] = {
    "label_budget": 80,
    "initial_labels": 60,
    "labels_per_version": 20,
    "labels_per_pair": 3,
    "overlap_share": 1.0,
}


def teacher(harness: WorkerHarness, name: str) -> UserRow:
    with harness.database.transaction() as session:
        return accounts.create_user(session, name, Role.TEACHER)[0]


@pytest.fixture
def worker(harness: WorkerHarness) -> SingleThreadedRewardWorker:
    return SingleThreadedRewardWorker(harness.context)


def open_queries(harness: WorkerHarness, worker: SingleThreadedRewardWorker, **changes: Any) -> str:
    """An experiment whose first queries are open."""
    id = harness.create_experiment(**{**SETTINGS, "segment_steps": 5, **changes})
    with harness.training(id) as run:
        for _ in range(3):
            run.step()
    worker.work()
    return id


def reliabilities(harness: WorkerHarness) -> dict[str, tuple[Any, ...]]:
    rows = harness.rows(
        "SELECT u.name, r.labels, r.accuracy, r.mean_weight FROM labeller_reliabilities r"
        " JOIN users u ON u.id = r.user_id"
    )
    return {row[0]: row[1:] for row in rows}


def label_as_three(harness: WorkerHarness, id: str) -> tuple[UserRow, UserRow]:
    """Labels of twenty pairs by the teacher of the harness and two others; the last prefers the worse segment."""
    good, opposite = teacher(harness, "good"), teacher(harness, "opposite")
    for _ in range(4):
        harness.label(id, 5)
        harness.label(id, 5, by=good)
        queries = harness.label(id, 5, by=opposite)
        for query_id in queries:
            [(better,)] = harness.rows(
                "SELECT a.true_return > b.true_return FROM queries q JOIN segments a ON a.id = q.segment_0_id"
                " JOIN segments b ON b.id = q.segment_1_id WHERE q.id = ?",
                query_id,
            )
            relabel(harness, opposite, query_id, 1.0 - better)
    return good, opposite


def relabel(harness: WorkerHarness, user: UserRow, query_id: str, value: float) -> None:
    with harness.database.transaction() as session:
        label.put_label(session, user, query_id, value)


@pytest.mark.slow
def test_labels_of_an_opposite_labeller_lose_their_weight(harness: WorkerHarness, worker):
    id = open_queries(harness, worker)
    label_as_three(harness, id)
    assert worker.work()
    found = reliabilities(harness)
    assert [found[name][0] for name in sorted(found)] == [20, 20, 20]
    assert found["opposite"][1] < 0.5 < found["good"][1]
    assert found["opposite"][2] < found["good"][2]
    [(weight,)] = harness.rows("SELECT json_extract(metrics, '$.label_weight') FROM reward_versions")
    assert weight == pytest.approx(sum(each[2] for each in found.values()) / 3)
    # The ensemble of a version gets the weights that are stored with it.
    with harness.database.reading() as session:
        version = publish.newest(session, id)
        assert version is not None
        labels = publish.training_labels(session, id)
        stored = publish.reliabilities(session, version)
    dataset = SegmentCache(harness.context.blobs).dataset(id, labels.items)
    again = weights_of_version(dataset, labels.items, stored)
    assert again.weights == pytest.approx(weight_labels(dataset, labels.items, labels.gold).dataset.weights)
    assert len(set(again.weights.tolist())) > 2


@pytest.mark.slow
def test_labels_of_one_labeller_are_not_weighted(harness: WorkerHarness, worker):
    id = open_queries(harness, worker, labels_per_pair=1)
    harness.label(id, 60)
    assert worker.work()
    assert reliabilities(harness) == {}
    assert harness.rows("SELECT json_extract(metrics, '$.label_weight') FROM reward_versions") == [(None,)]


def test_labels_are_not_weighted_where_the_experiment_does_not_want_it(harness: WorkerHarness, worker):
    id = open_queries(harness, worker, weight_labellers=False)
    label_as_three(harness, id)
    assert worker.work()
    assert reliabilities(harness) == {}


def test_decided_labels_keep_their_weight_and_measure_their_labellers(harness: WorkerHarness, worker):
    id = open_queries(harness, worker)
    label_as_three(harness, id)
    with harness.database.transaction() as session:
        researcher = accounts.create_user(session, "researcher", Role.RESEARCHER)[0]
    decided = harness.rows(
        "SELECT l.query_id, l.value FROM labels l JOIN users u ON u.id = l.user_id WHERE u.name = 'opposite'"
    )
    with harness.database.transaction() as session:
        for query_id, value in decided:
            label.put_label(session, researcher, query_id, 1.0 - value, final=True)
    assert worker.work()
    found = reliabilities(harness)
    assert found["opposite"][1] < 0.35
    assert found["opposite"][2] == 1
