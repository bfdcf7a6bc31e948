"""One experiment that cannot be trained must not stop the others, and says why it fails."""

from pathlib import Path

import pytest

from accord.domain.enums import WorkerRole
from accord.services import attempts, experiments
from accord.workers.policy_worker import PolicyWorker
from integration.workers.test_policy_worker import status_of, train_first_version
from integration.workers.worker_harness import STEPS_PER_ITERATION, SingleThreadedRewardWorker, WorkerHarness


def blob(harness: WorkerHarness, key: str) -> Path:
    return harness.home / "blobs" / key


def checkpoint_blobs(harness: WorkerHarness, id: str) -> list[Path]:
    """Newest first."""
    rows = harness.rows("SELECT blob_key FROM policy_checkpoints WHERE experiment_id = ? ORDER BY steps DESC", id)
    return [blob(harness, key) for (key,) in rows]


def save_checkpoints(harness: WorkerHarness, id: str, count: int) -> None:
    with harness.training(id) as run:
        for _ in range(count):
            assert run.step()
            run.save_progress()


def let_retry_now(harness: WorkerHarness) -> None:
    with harness.database.transaction() as session:
        for role in (WorkerRole.POLICY, WorkerRole.REWARD):
            for row in attempts.failing(session, role).values():
                row.retry_at = row.retry_at.replace(year=2000)


@pytest.mark.parametrize("content", [b"", b"not a checkpoint"])
def test_training_resumes_from_the_newest_checkpoint_that_can_be_read(harness: WorkerHarness, content: bytes):
    id = harness.create_experiment(reward_source="true")
    save_checkpoints(harness, id, 3)
    checkpoint_blobs(harness, id)[0].write_bytes(content)
    with harness.training(id) as run:
        assert run.steps == 2 * STEPS_PER_ITERATION
    checkpoint_blobs(harness, id)[1].unlink()
    with harness.training(id) as run:
        assert run.steps == STEPS_PER_ITERATION
    harness.train(id)
    assert status_of(harness, id)[0] == "finished"


def test_without_a_readable_checkpoint_the_experiment_fails_and_the_next_one_trains(harness: WorkerHarness):
    first, second = (harness.create_experiment(name, reward_source="true") for name in ("first", "second"))
    save_checkpoints(harness, first, 2)
    paths = checkpoint_blobs(harness, first)
    for path in paths:
        path.write_bytes(b"xx")
    worker = PolicyWorker(harness.context)
    while worker.work():
        pass
    status, _, detail, _ = status_of(harness, first)
    assert status == "failed"
    assert paths[0].name in detail
    assert status_of(harness, second)[0] == "finished"


@pytest.mark.slow
def test_the_policy_uses_the_newest_reward_version_that_can_be_read(harness: WorkerHarness):
    id = harness.create_experiment()
    train_first_version(harness, id)
    harness.train(id)
    reward = SingleThreadedRewardWorker(harness.context)
    reward.work()
    harness.label(id, 8)
    assert reward.work()
    [(first, _), (second, key)] = harness.rows("SELECT id, blob_key FROM reward_versions ORDER BY number")
    blob(harness, key).write_bytes(b"damaged")
    harness.train(id)
    assert status_of(harness, id)[0] == "finished"
    used = {row[0] for row in harness.rows("SELECT DISTINCT reward_version_id FROM metrics WHERE name = 'value_loss'")}
    assert first in used
    assert second not in used


def test_an_experiment_whose_only_reward_version_is_missing_waits_while_others_train(harness: WorkerHarness):
    broken = harness.create_experiment("broken", label_budget=8)
    train_first_version(harness, broken)
    [(key,)] = harness.rows("SELECT blob_key FROM reward_versions")
    blob(harness, key).unlink()
    sound = harness.create_experiment("sound", reward_source="true")
    worker = PolicyWorker(harness.context)
    assert worker.work()
    assert worker.work()
    assert status_of(harness, sound)[0] == "finished"
    with harness.database.reading() as session:
        assert key in attempts.problems(session, [broken])[broken]
    for _ in range(attempts.LIMIT):
        let_retry_now(harness)
        worker.work()
    status, _, detail, _ = status_of(harness, broken)
    assert status == "failed"
    assert key in detail


def test_failures_are_forgotten_once_training_passes_the_step_of_the_last_one(harness: WorkerHarness):
    id = harness.create_experiment(label_budget=8)
    train_first_version(harness, id)
    [(key,)] = harness.rows("SELECT blob_key FROM reward_versions")
    path = blob(harness, key)
    content = path.read_bytes()
    path.unlink()
    worker = PolicyWorker(harness.context)
    assert worker.work()
    assert harness.rows("SELECT role, failures FROM attempts") == [("policy", 1)]
    path.write_bytes(content)
    let_retry_now(harness)
    assert worker.work()
    assert harness.rows("SELECT count(*) FROM attempts") == [(0,)]
    assert status_of(harness, id)[0] == "finished"


def test_a_version_is_trained_without_the_labels_of_a_damaged_segment(harness: WorkerHarness):
    id = harness.create_experiment()
    reward = SingleThreadedRewardWorker(harness.context)
    harness.train(id)
    assert reward.work()
    labelled = harness.label(id, 8)
    [(key,)] = harness.rows(
        "SELECT s.blob_key FROM queries q JOIN segments s ON s.id = q.segment_0_id WHERE q.id = ?", labelled[0]
    )
    [(uses,)] = harness.rows(
        "SELECT count(*) FROM queries q JOIN labels l ON l.query_id = q.id JOIN segments s"
        " ON s.id IN (q.segment_0_id, q.segment_1_id) WHERE s.blob_key = ?",
        key,
    )
    blob(harness, key).write_bytes(b"\0" * 40)
    assert reward.work()
    [(metrics,)] = harness.rows("SELECT json_extract(metrics, '$.labels_unreadable') FROM reward_versions")
    assert metrics == uses


def test_attempts_that_end_without_a_word_count_and_resuming_forgets_them(harness: WorkerHarness):
    id = harness.create_experiment(reward_source="true")
    for _ in range(attempts.LIMIT):
        with harness.database.transaction() as session:
            assert attempts.begin(session, id, WorkerRole.POLICY) is not None
    with harness.database.transaction() as session:
        assert attempts.begin(session, id, WorkerRole.POLICY) is None
    status, _, detail, _ = status_of(harness, id)
    assert status == "failed"
    assert "policy.n_envs" in detail
    with harness.database.transaction() as session:
        experiments.resume(session, id)
    assert PolicyWorker(harness.context).work()
    assert status_of(harness, id)[0] == "finished"
