import pytest

from integration.workers.workplace import SingleThreadedRewardWorker, Workplace


@pytest.fixture
def asked(place: Workplace) -> tuple[SingleThreadedRewardWorker, str]:
    """An experiment whose first queries are open."""
    id = place.begin()
    with place.training(id) as run:
        run.step()
    worker = SingleThreadedRewardWorker(place.context)
    assert worker.work()
    return worker, id


def versions(place: Workplace) -> list[tuple[int, int, int]]:
    return place.rows("SELECT number, label_count, label_watermark FROM reward_versions ORDER BY number")


def test_queries_are_those_due_and_the_lookahead(place: Workplace, asked):
    worker, _ = asked
    assert place.rows("SELECT count(*) FROM queries WHERE status = 'open'") == [(16,)]
    assert not worker.work()
    pairs = place.rows("SELECT DISTINCT min(segment_0_id, segment_1_id), max(segment_0_id, segment_1_id) FROM queries")
    assert len(pairs) == 16


def test_no_queries_without_segments(place: Workplace):
    place.begin()
    assert not SingleThreadedRewardWorker(place.context).work()


def test_first_version_comes_with_the_first_labels_and_not_before(place: Workplace, asked):
    worker, id = asked
    place.label(id, 7)
    assert not worker.work()
    place.label(id, 1)
    assert worker.work()
    assert versions(place) == [(1, 8, 8)]
    assert not worker.work()
    [(accuracy,)] = place.rows("SELECT value FROM metrics WHERE name = 'holdout_accuracy'")
    assert 0.0 <= accuracy <= 1.0


def test_each_version_is_the_child_of_the_one_before(place: Workplace, asked):
    worker, id = asked
    for count in (8, 4):
        place.label(id, count)
        assert worker.work()
    assert versions(place) == [(1, 8, 8), (2, 12, 12)]
    [(parent,)] = place.rows("SELECT parent_id FROM reward_versions WHERE number = 2")
    assert (parent,) in place.rows("SELECT id FROM reward_versions WHERE number = 1")


def test_changed_labels_give_a_new_version(place: Workplace, asked):
    worker, id = asked
    labelled = place.label(id, 8)
    assert worker.work()
    place.relabel(labelled[:4], 0.5)
    assert worker.work()
    [(_, count, watermark)] = versions(place)[1:]
    assert count == 8
    assert watermark > 8


def test_the_last_label_gives_a_version_although_few_are_new(place: Workplace, asked):
    worker, id = asked
    place.label(id, 15)
    assert worker.work()
    place.label(id, 1)
    assert worker.work()
    assert versions(place)[-1][:2] == (2, 16)


def test_a_stop_in_the_middle_of_training_publishes_nothing(place: Workplace, asked):
    worker, id = asked
    place.label(id, 8)
    place.context.stop.request()
    assert not worker.work()
    assert versions(place) == []


@pytest.mark.parametrize("setting", ["reward_preset", "query_selection"])
def test_a_setting_of_another_version_fails_the_experiment(place: Workplace, setting: str):
    id = place.begin()
    with place.database.transaction() as session:
        session.connection().exec_driver_sql(f"UPDATE experiments SET config = json_set(config, '$.{setting}', 'huge')")
    with place.training(id) as run:
        run.step()
    worker = SingleThreadedRewardWorker(place.context)
    worker.work()
    if setting == "reward_preset":
        place.label(id, 8)
        worker.work()
    [(status, detail)] = place.rows("SELECT status, phase_detail FROM experiments")
    assert status == "failed"
    assert "huge" in detail


def test_a_paused_experiment_is_not_trained(place: Workplace, asked):
    worker, id = asked
    place.label(id, 8)
    with place.database.transaction() as session:
        session.connection().exec_driver_sql("UPDATE experiments SET status = 'paused'")
    assert not worker.work()
