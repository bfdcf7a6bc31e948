import pytest

from accord.workers.model_store import read_reward_model
from integration.workers.worker_harness import SingleThreadedRewardWorker, WorkerHarness
from mapt.rewards import novelty


@pytest.fixture
def first_queries(harness: WorkerHarness) -> tuple[SingleThreadedRewardWorker, str]:
    """An experiment whose first queries are open."""
    id = harness.create_experiment()
    with harness.training(id) as run:
        run.step()
    worker = SingleThreadedRewardWorker(harness.context)
    assert worker.work()
    return worker, id


def versions(harness: WorkerHarness) -> list[tuple[int, int, int]]:
    return harness.rows("SELECT number, label_count, label_watermark FROM reward_versions ORDER BY number")


def test_due_queries_and_the_lookahead_are_created(harness: WorkerHarness, first_queries):
    worker, _ = first_queries
    assert harness.rows("SELECT count(*) FROM queries WHERE status = 'open'") == [(16,)]
    assert not worker.work()
    pairs = harness.rows(
        "SELECT DISTINCT min(segment_0_id, segment_1_id), max(segment_0_id, segment_1_id) FROM queries"
    )
    assert len(pairs) == 16


def test_no_queries_are_created_without_segments(harness: WorkerHarness):
    harness.create_experiment()
    assert not SingleThreadedRewardWorker(harness.context).work()


def test_the_first_version_needs_all_initial_labels(harness: WorkerHarness, first_queries):
    worker, id = first_queries
    harness.label(id, 7)
    assert not worker.work()
    harness.label(id, 1)
    assert worker.work()
    assert versions(harness) == [(1, 8, 8)]
    assert not worker.work()
    [(accuracy,)] = harness.rows("SELECT value FROM metrics WHERE name = 'holdout_accuracy'")
    assert 0.0 <= accuracy <= 1.0


def test_the_parent_of_each_version_is_the_previous_one(harness: WorkerHarness, first_queries):
    worker, id = first_queries
    for count in (8, 4):
        harness.label(id, count)
        assert worker.work()
    assert versions(harness) == [(1, 8, 8), (2, 12, 12)]
    [(parent,)] = harness.rows("SELECT parent_id FROM reward_versions WHERE number = 2")
    assert (parent,) in harness.rows("SELECT id FROM reward_versions WHERE number = 1")


@pytest.mark.parametrize("weight", [0.0, 2.0])
def test_a_version_penalises_unknown_states_if_the_experiment_asks_for_it(
    harness: WorkerHarness, weight: float, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(novelty, "UPDATES", 5)
    id = harness.create_experiment(novelty_weight=weight)
    with harness.training(id) as run:
        run.step()
    worker = SingleThreadedRewardWorker(harness.context)
    assert worker.work()
    harness.label(id, 8)
    assert worker.work()
    [(blob_key,)] = harness.rows("SELECT blob_key FROM reward_versions")
    model = read_reward_model(harness.context.blobs, blob_key)
    assert (0.0 if model.novelty is None else model.novelty.weight.item()) == weight


def test_changed_labels_lead_to_a_new_version(harness: WorkerHarness, first_queries):
    worker, id = first_queries
    labelled = harness.label(id, 8)
    assert worker.work()
    harness.relabel(labelled[:4], 0.5)
    assert worker.work()
    [(_, count, watermark)] = versions(harness)[1:]
    assert count == 8
    assert watermark > 8


def test_the_last_label_leads_to_a_version_although_few_labels_are_new(harness: WorkerHarness, first_queries):
    worker, id = first_queries
    harness.label(id, 15)
    assert worker.work()
    harness.label(id, 1)
    assert worker.work()
    assert versions(harness)[-1][:2] == (2, 16)


def test_a_stop_during_training_publishes_no_version(harness: WorkerHarness, first_queries):
    worker, id = first_queries
    harness.label(id, 8)
    harness.context.stop.request()
    assert not worker.work()
    assert versions(harness) == []


@pytest.mark.parametrize("setting", ["reward_preset", "query_selection"])
def test_a_setting_of_another_version_fails_the_experiment(harness: WorkerHarness, setting: str):
    id = harness.create_experiment()
    with harness.database.transaction() as session:
        session.connection().exec_driver_sql(f"UPDATE experiments SET config = json_set(config, '$.{setting}', 'huge')")
    with harness.training(id) as run:
        run.step()
    worker = SingleThreadedRewardWorker(harness.context)
    worker.work()
    if setting == "reward_preset":
        harness.label(id, 8)
        worker.work()
    [(status, detail)] = harness.rows("SELECT status, phase_detail FROM experiments")
    assert status == "failed"
    assert "huge" in detail


def test_a_paused_experiment_is_not_trained(harness: WorkerHarness, first_queries):
    worker, id = first_queries
    harness.label(id, 8)
    with harness.database.transaction() as session:
        session.connection().exec_driver_sql("UPDATE experiments SET status = 'paused'")
    assert not worker.work()
