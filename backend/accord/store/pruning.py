"""Rows of ended experiments that nothing needs any more: no label, no reward version, and no run that may resume."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import ColumnElement, and_, delete, exists, inspect, or_, select, tuple_, update
from sqlalchemy.orm import Session, aliased

from accord.store.database import in_parts
from accord.store.tables import (
    Base,
    ClipRow,
    ClipViewRow,
    ExperimentRow,
    PolicyCheckpointRow,
    QueryRow,
    RecordingViewRow,
    SegmentRow,
)


@dataclass(frozen=True, slots=True)
class Unneeded:
    """A row to delete, with its blob."""

    #: values of the primary key
    id: tuple[str, ...]
    blob_key: str


def unpaired_segments(session: Session, before: datetime) -> list[Unneeded]:
    """Segments that are in no query, of experiments that ended before a time."""
    paired = exists().where(or_(QueryRow.segment_0_id == SegmentRow.id, QueryRow.segment_1_id == SegmentRow.id))
    return _found(session, SegmentRow, before, ~paired)


def earlier_checkpoints(session: Session, before: datetime) -> list[Unneeded]:
    """All checkpoints but the last one of each experiment that ended before a time."""
    later = aliased(PolicyCheckpointRow)
    superseded = exists().where(
        later.experiment_id == PolicyCheckpointRow.experiment_id,
        or_(
            later.steps > PolicyCheckpointRow.steps,
            and_(later.steps == PolicyCheckpointRow.steps, later.id > PolicyCheckpointRow.id),
        ),
    )
    return _found(session, PolicyCheckpointRow, before, superseded)


def requested_videos(session: Session, table: type[ClipViewRow | RecordingViewRow], before: datetime) -> list[Unneeded]:
    """Videos that are rendered again when somebody asks for them, of experiments that ended before a time."""
    return _found(session, table, before, table.status == "ready")


def rendered_clips(session: Session, before: datetime) -> list[Unneeded]:
    """Clips that can be rendered again, of experiments that ended before a time.

    Those of tasks that render themselves are stored with their segments, and cannot.
    """
    stored = (ClipRow.size_bytes > 0) & ClipRow.blob_key.startswith("clips/", autoescape=True)
    return _found(session, ClipRow, before, (ClipRow.status == "ready") & stored)


def mark_deleted(session: Session, clip_ids: Sequence[tuple[str, ...]]) -> None:
    """Records that the blobs of clips are deleted."""
    for part in in_parts([id for (id,) in clip_ids]):
        session.execute(update(ClipRow).where(ClipRow.id.in_(part)).values(size_bytes=0))


def delete_segments(session: Session, ids: Sequence[tuple[str, ...]]) -> None:
    """Deletes segments, with clips of them that were never shown."""
    for part in in_parts([id for (id,) in ids]):
        clips = select(ClipRow.id).where(ClipRow.segment_id.in_(part))
        session.execute(delete(ClipViewRow).where(ClipViewRow.clip_id.in_(clips)))
        session.execute(delete(ClipRow).where(ClipRow.segment_id.in_(part)))
        session.execute(delete(SegmentRow).where(SegmentRow.id.in_(part)))


def delete_rows(session: Session, table: type[Base], ids: Sequence[tuple[str, ...]]) -> None:
    """Deletes rows to which no other row refers."""
    key = tuple_(*inspect(table).primary_key)
    for part in in_parts(ids):
        session.execute(delete(table).where(key.in_(part)))


def _found(session: Session, table: type[Base], before: datetime, condition: ColumnElement[bool]) -> list[Unneeded]:
    columns = table.__table__.c
    # Cancelled and finished experiments never run again.
    ended = exists().where(
        ExperimentRow.id == columns.experiment_id,
        ExperimentRow.status.in_(("finished", "cancelled")),
        ExperimentRow.ended_at < before,
    )
    key = inspect(table).primary_key
    rows = session.execute(select(columns.blob_key, *key).where(columns.blob_key.is_not(None), ended, condition))
    return [Unneeded(tuple(row[1:]), row[0]) for row in rows]
