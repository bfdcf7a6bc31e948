"""Import of an export: a new experiment begins with the labels of another one, so that nobody gives them again."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from accord.domain.enums import ExperimentStatus, QueryStatus, Role
from accord.domain.errors import Invalid
from accord.domain.ids import new_id
from accord.services import accounts, experiments
from accord.services.collect import NewSegment, StoredSegment, collect, store_arrays
from accord.services.experiment_config import ExperimentConfig, read_config
from accord.store.blobs import BlobStore
from accord.store.tables import LabelRevisionRow, LabelRow, QueryRow, utc_now
from mapt.preferences.formats import tables as exported
from mapt.preferences.formats.records import SegmentRecords
from mapt.preferences.formats.tables import PreferenceTables

#: Iteration and steps of the policy that produced imported segments: they are older than all of the new experiment's.
BEFORE_THE_RUN = -1


@dataclass(frozen=True, slots=True)
class Imported:
    """The content of an export, with its arrays stored."""

    experiment_id: str
    config: ExperimentConfig
    instructions: str
    #: id in the export -> segment
    segments: Mapping[str, StoredSegment]
    queries: list[exported.QueryRow]
    labels: list[exported.LabelRow]


def store(
    blobs: BlobStore, tables: PreferenceTables, on_segments: Callable[[int], None] = lambda _count: None
) -> Imported:
    """Stores the arrays of an export. Call it before the transaction that calls `create`.

    Args:
        on_segments: called with the number of segments stored so far.

    Raises:
        Invalid: if it is not the export of an experiment, or has no labels.
        InvalidExperiment: if this version of Accord cannot run its settings.
        PreferenceError: if a table is damaged.
        BlobsNotWritable: if the blobs are read-only or full.
    """
    about = tables.about
    if not isinstance(about.get("config"), Mapping):
        raise Invalid(f"{tables.path} does not hold an experiment of Accord: its metadata has no settings.")
    # Settings of other versions: those that are missing take today's defaults, and all are validated.
    config = read_config(ExperimentConfig.from_stored(about["config"]).to_dict())
    labels = sorted(tables.labels(), key=lambda label: (label.revision or 0, label.query_id))
    labelled = {label.query_id for label in labels if label.state == "label"}
    every = tables.queries()
    unknown = {label.query_id for label in labels} - {query.query_id for query in every}
    if unknown:
        raise Invalid(f"{tables.path} is incomplete: its labels refer to {len(unknown)} queries that it does not hold.")
    queries = [query for query in every if query.query_id in labelled]
    if not queries:
        raise Invalid(f"{tables.path} holds no labels to import.")
    experiment_id = new_id("exp")
    segments: dict[str, StoredSegment] = {}
    for rows, records in tables.segments():
        for row, segment in zip(rows, _segments(records), strict=True):
            stored = store_arrays(blobs, experiment_id, segment)
            segments[row.segment_id] = replace(stored, mujoco_version=row.mujoco_version or stored.mujoco_version)
        on_segments(len(segments))
    missing = {each for query in queries for each in (query.segment_0_id, query.segment_1_id)} - segments.keys()
    if missing:
        raise Invalid(
            f"{tables.path} is incomplete: its queries refer to {len(missing)} segments that it does not hold."
        )
    kept = [label for label in labels if label.query_id in labelled]
    return Imported(experiment_id, config, str(about.get("instructions", "")), segments, queries, kept)


def create(session: Session, owner_id: str, name: str, found: Imported) -> None:
    """Creates the experiment, paused, with the imported segments, queries and labels.

    Queries without a label are left out. The labels of teachers who are users of this installation stay theirs; every
    other teacher becomes a new user who cannot sign in.

    Raises:
        UnknownTask, InvalidExperiment, NameTaken, Invalid: as `experiments.create`.
    """
    row = experiments.create(
        session, owner_id, name, found.config, found.instructions, experiment_id=found.experiment_id
    )
    row.status = ExperimentStatus.PAUSED.value
    collect(session, row.id, list(found.segments.values()))
    query_ids: dict[str, str] = {}
    for number, query in enumerate(found.queries, 1):
        query_ids[query.query_id] = new_id("qry")
        session.add(
            QueryRow(
                id=query_ids[query.query_id],
                experiment_id=row.id,
                segment_0_id=found.segments[query.segment_0_id].id,
                segment_1_id=found.segments[query.segment_1_id].id,
                number=number,
                status=QueryStatus.CLOSED.value,
                selector=query.selector or "imported",
            )
        )
    session.flush()
    users = _users(session, row.name, found.labels)
    for revision, label in enumerate(found.labels, 1):
        given_at = label.labelled_at or utc_now()
        # what the label and its first revision have in common
        answer: dict[str, Any] = {
            "experiment_id": row.id,
            "revision": revision,
            "value": label.label,
            "state": label.state,
            "left_segment": label.left_segment,
            "response_seconds": label.response_seconds,
            "created_at": given_at,
        }
        label_row = LabelRow(
            id=new_id("lbl"),
            query_id=query_ids[label.query_id],
            user_id=users[label.teacher_id],
            teacher=dict(label.teacher),
            updated_at=given_at,
            **answer,
        )
        session.add(label_row)
        session.flush()
        session.add(LabelRevisionRow(label_id=label_row.id, **answer))
    row.label_revision = len(found.labels)
    row.label_count = sum(label.state == "label" for label in found.labels)
    session.flush()


def _segments(records: SegmentRecords) -> Iterator[NewSegment]:
    """Raises Invalid if there are no true rewards, which every experiment stores."""
    if records.rewards is None:
        raise Invalid("The segments of the export have no true rewards.")
    for index, length in enumerate(records.lengths):
        # A task without MuJoCo states has none.
        states = [
            np.zeros((length, 0)) if each is None else each[index, :length] for each in (records.qpos, records.qvel)
        ]
        yield NewSegment(
            observations=records.segments.observations[index, :length],
            actions=records.segments.actions[index, :length],
            rewards=records.rewards[index, :length],
            qpos=states[0],
            qvel=states[1],
            policy_iteration=BEFORE_THE_RUN,
            policy_steps=BEFORE_THE_RUN,
        )


def _users(session: Session, experiment_name: str, labels: list[exported.LabelRow]) -> dict[str, str]:
    """Id of a teacher in the export -> id of a user."""
    ids: dict[str, str] = {}
    for teacher_id in dict.fromkeys(label.teacher_id for label in labels):
        known = accounts.user_by_id(session, teacher_id)
        if known is None:
            name = f"{experiment_name[:60]}, imported {len(ids) + 1} {new_id('usr')[-6:]}"
            known, _token = accounts.create_user(session, name, Role.LABELLER)
        ids[teacher_id] = known.id
    return ids
