"""How many queries are wanted, and which are never made."""

import threading

import pytest

from accord.domain.enums import Role
from accord.domain.errors import SegmentNotFound
from accord.services import clips, collect, experiments, label, select
from accord.store.tables import ExperimentRow, QueryRow
from support.scenes import config, make_clips, scene, segment, user
from support.stores import Stores


def wanted(stores: Stores, experiment_id: str) -> int:
    with stores.database.reading() as session:
        return select.queries_to_add(session, experiments.get(session, experiment_id))


def set_steps(stores: Stores, experiment_id: str, steps: int) -> None:
    with stores.database.transaction() as session:
        experiments.get(session, experiment_id).steps = steps


def test_queries_are_added_for_due_labels_and_the_lookahead_up_to_the_budget(both: Stores) -> None:
    made = scene(both.database, both.blobs, segments=2, queries=0)
    # 10 labels before the first version, 4 ahead
    assert wanted(both, made.experiment.id) == 14
    set_steps(both, made.experiment.id, 10_000)
    assert wanted(both, made.experiment.id) == 20


def test_the_budget_allows_the_queries_that_do_not_exist_yet(both: Stores) -> None:
    made = scene(both.database, both.blobs, queries=6)
    with both.database.transaction() as session:
        row = experiments.get(session, made.experiment.id)
        assert select.queries_within_budget(session, row) == 14
        one, _ = user(session, "one", Role.TEACHER)
        label.put_label(session, one, made.query_ids[0], None)
        assert select.queries_within_budget(session, row) == 15


def test_existing_queries_are_not_added_again(both: Stores) -> None:
    made = scene(both.database, both.blobs, queries=6, ready=False)
    assert wanted(both, made.experiment.id) == 8


def test_segments_are_exhausted_once_every_pair_is_answered(both: Stores) -> None:
    made = scene(both.database, both.blobs, segments=3, queries=3)
    another = collect.store_arrays(both.blobs, made.experiment.id, segment())
    with both.database.transaction() as session:
        row = experiments.get(session, made.experiment.id)
        one, _ = user(session, "one", Role.TEACHER)
        for query_id in made.query_ids[:2]:
            label.put_label(session, one, query_id, 1.0)
        assert not select.exhausted(session, row)
        label.put_label(session, one, made.query_ids[2], None)
        assert select.exhausted(session, row), "a skip brings no label"
        label.put_label(session, one, made.query_ids[2], 0.0)
        assert select.exhausted(session, row)
        collect.collect(session, made.experiment.id, [another])
        assert not select.exhausted(session, row)


@pytest.mark.parametrize("verb", [experiments.pause, experiments.cancel, experiments.finish])
def test_an_experiment_that_does_not_run_gets_no_queries(sqlite: Stores, verb: object) -> None:
    made = scene(sqlite.database, sqlite.blobs, queries=1)
    with sqlite.database.transaction() as session:
        verb(session, made.experiment.id)  # type: ignore[operator]
    assert wanted(sqlite, made.experiment.id) == 0


def test_a_policy_that_learns_from_the_true_reward_gets_no_queries(sqlite: Stores) -> None:
    made = scene(sqlite.database, sqlite.blobs, segments=0, queries=0, reward_source="true")
    assert wanted(sqlite, made.experiment.id) == 0


def test_a_skipped_query_is_replaced_until_it_is_labelled(both: Stores) -> None:
    made = scene(both.database, both.blobs, queries=4)
    before = wanted(both, made.experiment.id)
    with both.database.transaction() as session:
        one, _ = user(session, "one", Role.TEACHER)
        two, _ = user(session, "two", Role.TEACHER)
        label.put_label(session, one, made.query_ids[0], None)
    assert wanted(both, made.experiment.id) == before + 1
    with both.database.transaction() as session:
        label.put_label(session, two, made.query_ids[0], 1.0)
    assert wanted(both, made.experiment.id) == before


def test_a_query_whose_clip_failed_is_replaced(both: Stores) -> None:
    made = scene(both.database, both.blobs, segments=3, queries=3, ready=False)
    before = wanted(both, made.experiment.id)
    with both.database.transaction() as session:
        job = clips.claim_pending(session, "worker", 60)
        assert job is not None
        clips.fail(session, job.clip_id, "broken", retry=False)
    # each of 3 segments is in 2 of the 3 queries
    assert wanted(both, made.experiment.id) == before + 2
    # and no new query is made over that segment
    with both.database.transaction() as session:
        row = experiments.get(session, made.experiment.id)
        others = [each for each in made.segment_ids if each != job.segment_id]
        assert select.add_queries(session, row, [(job.segment_id, others[0])], "uniform") == []
        # so that it is no use to choose it
        assert select.selectable_segments(session, row.id) == others[::-1]
        assert select.selectable_segments(session, row.id, 1) == others[-1:]


def test_a_pair_has_one_query_in_either_order(both: Stores) -> None:
    made = scene(both.database, both.blobs, segments=3, queries=0)
    a, b, c = made.segment_ids
    with both.database.transaction() as session:
        row = experiments.get(session, made.experiment.id)
        first = select.add_queries(session, row, [(a, b), (b, a), (a, b), (c, c)], "uniform")
        again = select.add_queries(session, row, [(b, a), (c, b)], "uniform")
        assert (len(first), len(again)) == (1, 1)
        assert select.existing_pairs(session, row.id) == {frozenset((a, b)), frozenset((b, c))}


def test_queries_are_numbered_consecutively(both: Stores) -> None:
    made = scene(both.database, both.blobs, segments=4, queries=5, ready=False)
    with both.database.reading() as session:
        rows = [session.get(QueryRow, each) for each in made.query_ids]
        assert [row.number for row in rows if row] == [1, 2, 3, 4, 5]


def test_a_segment_of_another_experiment_is_refused(both: Stores) -> None:
    made, other = (scene(both.database, both.blobs, segments=2, queries=0) for _ in range(2))
    with both.database.transaction() as session:
        row = experiments.get(session, made.experiment.id)
        with pytest.raises(SegmentNotFound):
            select.add_queries(session, row, [(made.segment_ids[0], other.segment_ids[0])], "uniform")


def test_without_clips_a_query_is_open_at_once(both: Stores) -> None:
    made = scene(both.database, both.blobs, queries=2, ready=False, render_clips=False)
    with both.database.reading() as session:
        assert {session.get(QueryRow, each).status for each in made.query_ids} == {"open"}  # type: ignore[union-attr]
    assert make_clips(both.database, both.blobs) == 0


def test_a_query_whose_clips_exist_is_open_at_once(both: Stores) -> None:
    made = scene(both.database, both.blobs, segments=3, queries=2)
    with both.database.transaction() as session:
        row = experiments.get(session, made.experiment.id)
        (added,) = select.add_queries(session, row, [(made.segment_ids[1], made.segment_ids[2])], "uniform")
        query = session.get(QueryRow, added)
        assert query is not None
        assert query.status == "open"


def test_candidates_are_the_newest_segments_first(both: Stores) -> None:
    made = scene(both.database, both.blobs, segments=5, queries=0)
    with both.database.reading() as session:
        found = select.candidates(session, made.experiment.id, 3)
        assert [steps for _, steps in found] == [400, 300, 200]
        assert [segment_id for segment_id, _ in found] == made.segment_ids[:1:-1]
        assert set(select.segment_blobs(session, made.segment_ids)) == set(made.segment_ids)


def test_queries_added_concurrently_get_different_numbers(both: Stores) -> None:
    made = scene(both.database, both.blobs, segments=9, queries=0)
    ready = threading.Barrier(4)

    def add(first: int) -> None:
        ready.wait()
        for second in range(first + 1, 9):
            with both.database.transaction() as session:
                row = experiments.get(session, made.experiment.id)
                select.add_queries(session, row, [(made.segment_ids[first], made.segment_ids[second])], "uniform")

    threads = [threading.Thread(target=add, args=(first,)) for first in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with both.database.reading() as session:
        numbers = sorted(row.number for row in session.query(QueryRow))
    assert numbers == list(range(1, 8 + 7 + 6 + 5 + 1))


def test_settings_survive_the_database(sqlite: Stores) -> None:
    made = scene(
        sqlite.database, sqlite.blobs, segments=0, queries=0, policy={"learning_rate": 0.1, "shared_actor": True}
    )
    with sqlite.database.reading() as session:
        row = session.get(ExperimentRow, made.experiment.id)
        assert row is not None
        assert experiments.config_of(row) == config(policy={"learning_rate": 0.1, "shared_actor": True})
