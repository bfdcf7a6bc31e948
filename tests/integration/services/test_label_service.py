"""Labels: what is accepted, what is refused, and what it does to the counters."""

import math

import pytest
from sqlalchemy import select as sql_select

from accord.domain.enums import Role
from accord.domain.errors import (
    ExperimentNotActive,
    Invalid,
    InvalidLabel,
    LabelConflict,
    LabelNotFound,
    LeaseLost,
    QueryClosed,
    QueryNotFound,
)
from accord.domain.ids import new_id
from accord.services import experiments, label, lease, publish
from accord.services.label import LabelOutcome
from accord.store.tables import LabelRevisionRow, LabelRow, QueryRow, UserRow
from support.scenes import Scene, scene, user
from support.stores import Stores


def person(stores: Stores, name: str = "ada", role: Role = Role.LABELLER) -> UserRow:
    with stores.database.transaction() as session:
        return user(session, name, role)[0]


def leased(stores: Stores, who: UserRow, made: Scene, count: int = 1) -> list[lease.LeasedQuery]:
    with stores.database.transaction() as session:
        return lease.next_queries(session, who, made.experiment.id, count, 60.0).items


def put(stores: Stores, who: UserRow, query_id: str, value: float | None, **options: object) -> LabelOutcome:
    with stores.database.transaction() as session:
        return label.put_label(session, who, query_id, value, **options)  # type: ignore[arg-type]


def counters(stores: Stores, made: Scene) -> tuple[int, int]:
    """Labels that count, and the newest revision."""
    with stores.database.reading() as session:
        row = experiments.get(session, made.experiment.id)
        return row.label_count, row.label_revision


def status(stores: Stores, query_id: str) -> str:
    with stores.database.reading() as session:
        row = session.get(QueryRow, query_id)
        assert row is not None
        return row.status


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_label_is_stored_and_closes_its_query(both: Stores, value: float) -> None:
    made, ada = scene(both.database, both.blobs), person(both)
    (query,) = leased(both, ada, made)
    outcome = put(both, ada, query.id, value, response_seconds=2.5)
    assert (outcome.created, outcome.row.value, outcome.row.state, outcome.row.revision) == (True, value, "label", 1)
    assert outcome.row.left_segment == query.left_segment
    assert status(both, query.id) == "closed"
    assert counters(both, made) == (1, 1)
    with both.database.reading() as session:
        row = session.scalars(sql_select(LabelRow)).one()
        assert (row.value, row.response_seconds, row.user_id) == (value, 2.5, ada.id)


def test_sending_a_label_twice_stores_one_label(both: Stores) -> None:
    made, ada = scene(both.database, both.blobs), person(both)
    (query,) = leased(both, ada, made)
    first = put(both, ada, query.id, 1.0, response_seconds=1.0)
    again = put(both, ada, query.id, 1.0, response_seconds=9.0)
    assert (first.created, again.created) == (True, False)
    assert again.row == first.row
    assert counters(both, made) == (1, 1)


@pytest.mark.parametrize("left", [0, 1])
@pytest.mark.parametrize(("said", "stored_if_left_is_0"), [(1.0, 1.0), (0.0, 0.0), (0.5, 0.5), (None, None)])
def test_a_label_in_shown_order_is_converted_to_segment_order(
    sqlite: Stores, left: int, said: float | None, stored_if_left_is_0: float | None
) -> None:
    made, ada = scene(sqlite.database, sqlite.blobs, segments=10, queries=20), person(sqlite)
    query = next(each for each in leased(sqlite, ada, made, 20) if each.left_segment == left)
    stored = put(sqlite, ada, query.id, said, order="shown").row
    expected = stored_if_left_is_0 if said is None or left == 0 else 1.0 - said
    assert (stored.value, stored.left_segment) == (expected, left)


@pytest.mark.parametrize("value", [0.7, -1.0, 2.0, math.nan, math.inf, 0.49999999999])
def test_any_other_value_is_refused(sqlite: Stores, value: float) -> None:
    made, ada = scene(sqlite.database, sqlite.blobs), person(sqlite)
    (query,) = leased(sqlite, ada, made)
    with pytest.raises(InvalidLabel):
        put(sqlite, ada, query.id, value)
    assert counters(sqlite, made) == (0, 0)


def test_a_skip_is_stored_but_not_counted_and_leaves_the_query_open(both: Stores) -> None:
    made, ada, bob = scene(both.database, both.blobs, queries=1), person(both, "ada"), person(both, "bob")
    (query,) = leased(both, ada, made)
    assert put(both, ada, query.id, None).row.state == "skip"
    assert not put(both, ada, query.id, None).created
    assert (status(both, query.id), counters(both, made)) == ("open", (0, 1))
    assert [each.id for each in leased(both, bob, made)] == [query.id]
    put(both, bob, query.id, 1.0)
    assert counters(both, made) == (1, 2)


def test_an_author_may_change_a_label_and_its_history_is_kept(both: Stores) -> None:
    made, ada = scene(both.database, both.blobs), person(both)
    (query,) = leased(both, ada, made)
    for value in (1.0, 0.0, None, 0.5):
        assert put(both, ada, query.id, value).created
    assert counters(both, made) == (1, 4)
    with both.database.reading() as session:
        words = session.execute(
            sql_select(LabelRevisionRow.revision, LabelRevisionRow.state, LabelRevisionRow.value).order_by(
                LabelRevisionRow.revision
            )
        ).all()
    assert [tuple(word) for word in words] == [
        (1, "label", 1.0),
        (2, "label", 0.0),
        (3, "skip", None),
        (4, "label", 0.5),
    ]


def test_a_query_that_another_has_labelled_is_closed(both: Stores) -> None:
    made, ada, bob = scene(both.database, both.blobs, queries=1), person(both, "ada"), person(both, "bob", Role.TEACHER)
    (query,) = leased(both, ada, made)
    put(both, ada, query.id, 1.0)
    with pytest.raises(QueryClosed):
        put(both, bob, query.id, 1.0)


def test_a_query_leased_to_another_cannot_be_labelled_even_by_an_admin(both: Stores) -> None:
    made, ada, root = scene(both.database, both.blobs, queries=1), person(both, "ada"), person(both, "root", Role.ADMIN)
    (query,) = leased(both, ada, made)
    with pytest.raises(LeaseLost):
        put(both, root, query.id, 1.0)


@pytest.mark.parametrize("role", list(Role))
def test_only_programs_and_researchers_label_without_a_lease(sqlite: Stores, role: Role) -> None:
    made, someone = scene(sqlite.database, sqlite.blobs, queries=1), person(sqlite, role=role)
    if role is Role.LABELLER:
        with pytest.raises(LeaseLost):
            put(sqlite, someone, made.query_ids[0], 1.0)
    else:
        assert put(sqlite, someone, made.query_ids[0], 1.0).row.left_segment is None


def test_shown_order_needs_a_query_that_was_shown(sqlite: Stores) -> None:
    made, teacher = scene(sqlite.database, sqlite.blobs, queries=1), person(sqlite, role=Role.TEACHER)
    with pytest.raises(LeaseLost):
        put(sqlite, teacher, made.query_ids[0], 1.0, order="shown")


def test_a_query_without_its_clips_cannot_be_labelled(both: Stores) -> None:
    made, teacher = scene(both.database, both.blobs, queries=1, ready=False), person(both, role=Role.TEACHER)
    with pytest.raises(LabelConflict):
        put(both, teacher, made.query_ids[0], 1.0)


def test_an_absent_query_and_one_of_another_experiment_are_named(both: Stores) -> None:
    made, other = scene(both.database, both.blobs), scene(both.database, both.blobs)
    teacher, absent = person(both, role=Role.TEACHER), new_id("qry")
    with pytest.raises(QueryNotFound):
        put(both, teacher, absent, 1.0)
    with pytest.raises(QueryNotFound):
        put(both, teacher, made.query_ids[0], 1.0, experiment_id=other.experiment.id)
    assert put(both, teacher, made.query_ids[0], 1.0, experiment_id=made.experiment.id).created


@pytest.mark.parametrize("verb", [experiments.cancel, experiments.finish])
def test_labels_of_an_ended_experiment_are_final(both: Stores, verb: object) -> None:
    made, ada = scene(both.database, both.blobs), person(both)
    first, second = leased(both, ada, made, 2)
    put(both, ada, first.id, 1.0)
    with both.database.transaction() as session:
        verb(session, made.experiment.id)  # type: ignore[operator]
    assert not put(both, ada, first.id, 1.0).created
    for refused in (first, second):
        with pytest.raises(ExperimentNotActive):
            put(both, ada, refused.id, 0.0)
    with both.database.transaction() as session, pytest.raises(ExperimentNotActive):
        label.undo(session, ada, first.id)


def test_a_leased_query_may_be_labelled_while_the_experiment_is_paused(both: Stores) -> None:
    made, ada = scene(both.database, both.blobs), person(both)
    (query,) = leased(both, ada, made)
    with both.database.transaction() as session:
        experiments.pause(session, made.experiment.id)
    assert put(both, ada, query.id, 1.0).created


def test_undo_reopens_the_query_for_its_author_on_the_same_sides(both: Stores) -> None:
    made, ada, bob = scene(both.database, both.blobs, queries=1), person(both, "ada"), person(both, "bob")
    (query,) = leased(both, ada, made)
    put(both, ada, query.id, 1.0)
    with both.database.transaction() as session:
        undone = label.undo(session, ada, query.id)
        assert (undone.state, undone.value, undone.revision) == ("undone", None, 2)
        assert lease.leased_query(session, ada, query.id) == query
    assert (status(both, query.id), counters(both, made)) == ("open", (0, 2))
    assert leased(both, bob, made) == []
    assert put(both, ada, query.id, 1.0).created
    assert counters(both, made) == (1, 3)


def test_only_an_existing_label_can_be_undone_and_only_once(both: Stores) -> None:
    made, ada, bob = scene(both.database, both.blobs), person(both, "ada"), person(both, "bob")
    (query,) = leased(both, ada, made)
    put(both, ada, query.id, 1.0)
    with both.database.transaction() as session:
        with pytest.raises(LabelNotFound):
            label.undo(session, bob, query.id)
        label.undo(session, ada, query.id)
        with pytest.raises(LabelNotFound):
            label.undo(session, ada, query.id)
        with pytest.raises(QueryNotFound):
            label.undo(session, ada, new_id("qry"))


def test_a_skip_of_a_query_that_another_has_labelled_cannot_be_undone(both: Stores) -> None:
    made, ada, bob = scene(both.database, both.blobs, queries=1), person(both, "ada"), person(both, "bob")
    (query,) = leased(both, ada, made)
    put(both, ada, query.id, None)
    leased(both, bob, made)
    with both.database.transaction() as session, pytest.raises(LeaseLost):
        label.undo(session, ada, query.id)
    put(both, bob, query.id, 0.0)
    with both.database.transaction() as session, pytest.raises(QueryClosed):
        label.undo(session, ada, query.id)


def test_a_teachers_description_is_kept_and_must_be_json(both: Stores) -> None:
    made, teacher = scene(both.database, both.blobs), person(both, role=Role.TEACHER)
    put(both, teacher, made.query_ids[0], 1.0, teacher={"name": "oracle", "beta": 10.0})
    with both.database.reading() as session:
        assert session.scalars(sql_select(LabelRow)).one().teacher == {"name": "oracle", "beta": 10.0}
    for bad in ({"beta": math.inf}, {"name": "x" * 5000}):
        with pytest.raises(Invalid):
            put(both, teacher, made.query_ids[1], 1.0, teacher=bad)


def test_training_labels_are_all_labels_up_to_the_watermark(both: Stores) -> None:
    made, teacher = scene(both.database, both.blobs, queries=4), person(both, role=Role.TEACHER)
    one, two, three, four = made.query_ids
    for query_id, value in ((four, 0.0), (one, 1.0), (two, None), (three, 0.5)):
        put(both, teacher, query_id, value)
    with both.database.transaction() as session:
        label.undo(session, teacher, three)
    with both.database.reading() as session:
        found = publish.training_labels(session, made.experiment.id)
        assert found.watermark == 5
        # in the order in which they were given, not that of the queries: the hold-out split goes by it
        assert [(each.query_id, each.value) for each in found.items] == [(four, 0.0), (one, 1.0)]
        assert [found.items[1].segment_0_id, found.items[1].segment_1_id] == made.segment_ids[:2]
        assert both.blobs.exists(found.items[0].segment_0_blob)
        assert publish.new_labels(session, made.experiment.id, 0) == 2
        assert publish.new_labels(session, made.experiment.id, found.watermark) == 0
    put(both, teacher, one, 0.0)
    with both.database.reading() as session:
        # an earlier label, changed after the watermark, is new again
        assert publish.new_labels(session, made.experiment.id, found.watermark) == 1
