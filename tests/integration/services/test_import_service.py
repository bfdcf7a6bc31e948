"""Import of an export into another installation, or into the same one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from accord.domain.enums import Role
from accord.domain.errors import Invalid, NameTaken
from accord.services import accounts, costs, experiments, export, importing, label, lease, publish, select
from accord.store.tables import UserRow
from mapt.preferences.formats.tables import PreferenceTables
from support.sample_experiments import SampleExperiment, create_sample, user
from support.stores import Stores


@pytest.fixture
def tables(stores: Stores, tmp_path: Path) -> tuple[SampleExperiment, PreferenceTables]:
    """The export of an experiment with four queries: two labels of a person, one of a program, and a skip."""
    sample = create_sample(stores.database, stores.blobs)
    with stores.database.transaction() as session:
        person, _ = user(session, "Ada")
        program, _ = user(session, "program", Role.TEACHER)
        lease.next_queries(session, person, sample.experiment.id, 4, 60.0)
        label.put_label(session, person, sample.query_ids[1], 1.0, response_seconds=2.5)
        label.put_label(session, person, sample.query_ids[0], 0.5, response_seconds=1.5)
        label.put_label(session, person, sample.query_ids[3], None)
        lease.release(session, person, sample.query_ids[2])
        label.put_label(session, program, sample.query_ids[2], 0.0, teacher={"name": "oracle"})
    return sample, exported(stores, sample.experiment.id, tmp_path / "first")


def exported(stores: Stores, experiment_id: str, folder: Path) -> PreferenceTables:
    with stores.database.reading() as session:
        found = export.contents(session, experiment_id)
    export.write(stores.blobs, found, folder)
    return PreferenceTables.open(folder)


def imported(stores: Stores, tables: PreferenceTables, name: str = "again") -> str:
    found = importing.store(stores.blobs, tables)
    with stores.database.transaction() as session:
        importing.create(session, accounts.ensure_admin(session).id, name, found)
    return found.experiment_id


def values(tables: PreferenceTables) -> list[tuple[object, ...]]:
    """Labels with the true rewards of their segments, which identify them."""
    rewards = {
        row.segment_id: float(records.extras()["rewards"][index].sum())
        for rows, records in tables.segments()
        for index, row in enumerate(rows)
    }
    queries = {each.query_id: (rewards[each.segment_0_id], rewards[each.segment_1_id]) for each in tables.queries()}
    return [
        (*queries[each.query_id], each.label, each.left_segment, each.response_seconds, dict(each.teacher))
        for each in tables.labels()
        if each.state == "label"
    ]


def test_an_imported_experiment_has_the_labels_and_segments_of_the_export(
    stores: Stores, tables: tuple[SampleExperiment, PreferenceTables], tmp_path: Path
) -> None:
    sample, first = tables
    id = imported(stores, first)
    second = exported(stores, id, tmp_path / "second")
    assert sorted(values(second), key=str) == sorted(values(first), key=str)
    ((_, before),), ((rows, after),) = first.segments(), second.segments()
    for name, array in before.extras().items():
        np.testing.assert_array_equal(np.sort(after.extras()[name], axis=0), np.sort(array, axis=0))
    assert {row.policy_steps for row in rows} == {importing.BEFORE_THE_RUN}
    with stores.database.reading() as session:
        row = experiments.get(session, id)
        assert (row.status, row.label_count, row.label_revision) == ("paused", 3, 3)
        assert row.config == sample.experiment.config
        found = publish.training_labels(session, id)
        assert sorted(each.value for each in found.items) == [0.0, 0.5, 1.0]
        cost = costs.costs_of(session, id)
        assert (cost.person_answers, cost.person_seconds, cost.program_labels) == (0, 0.0, 0)
        # The new policy's segments come first.
        assert all(steps < 0 for _, steps in select.candidates(session, id, limit=5))
        # The same installation knows both teachers.
        assert session.query(UserRow).filter(UserRow.name.contains("imported")).count() == 0


def test_teachers_of_another_installation_become_users(
    stores: Stores, tables: tuple[SampleExperiment, PreferenceTables]
) -> None:
    _, first = tables
    found = importing.store(stores.blobs, first)
    strangers = [replace(each, teacher_id=f"usr_of_another_{each.teacher_id[-3:]}") for each in found.labels]
    with stores.database.transaction() as session:
        importing.create(session, accounts.ensure_admin(session).id, "again", replace(found, labels=strangers))
        assert session.query(UserRow).filter(UserRow.name.contains("imported")).count() == 2


def test_what_cannot_be_imported_leaves_no_experiment(
    stores: Stores, tables: tuple[SampleExperiment, PreferenceTables]
) -> None:
    sample, first = tables
    with pytest.raises(NameTaken):
        imported(stores, first, sample.experiment.name)
    with pytest.raises(Invalid):
        importing.store(stores.blobs, replace(first, about={}))
    queries = first.path / "queries.parquet"
    pq.write_table(pq.read_table(queries)[:1], queries)
    with pytest.raises(Invalid):
        importing.store(stores.blobs, PreferenceTables.open(first.path))
    with stores.database.reading() as session:
        assert len(experiments.list_page(session, 10, None).rows) == 1
