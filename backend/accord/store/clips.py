"""Rows of clips."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import func, or_, select, union_all
from sqlalchemy.orm import Session

from accord.store.tables import ClipRow, ExperimentRow, QueryRow, SegmentRow


@dataclass(frozen=True, slots=True)
class PendingClip:
    """A clip to render, for which a query waits."""

    row: ClipRow
    task: str
    segment_blob_key: str


def get(session: Session, clip_id: str) -> ClipRow | None:
    return session.get(ClipRow, clip_id)


def lock(session: Session, clip_id: str) -> ClipRow | None:
    return session.get(ClipRow, clip_id, with_for_update=True, populate_existing=True)


def of_segments(session: Session, segment_ids: Sequence[str]) -> dict[str, ClipRow]:
    """Segment id -> its clip, if it has one."""
    rows = session.scalars(select(ClipRow).where(ClipRow.segment_id.in_(segment_ids)))
    return {row.segment_id: row for row in rows}


def lock_pending(session: Session, now: datetime) -> PendingClip | None:
    """Locks the unclaimed clip whose query has the lowest number; concurrent callers get different clips."""
    waiting = union_all(
        select(QueryRow.segment_0_id.label("segment_id"), QueryRow.number, QueryRow.experiment_id).where(
            QueryRow.status == "rendering"
        ),
        select(QueryRow.segment_1_id.label("segment_id"), QueryRow.number, QueryRow.experiment_id).where(
            QueryRow.status == "rendering"
        ),
    ).subquery()
    soonest = (
        select(waiting.c.segment_id, func.min(waiting.c.number).label("number"))
        .join(ExperimentRow, ExperimentRow.id == waiting.c.experiment_id)
        .where(ExperimentRow.status.in_(("running", "paused")))
        .group_by(waiting.c.segment_id)
        .subquery()
    )
    found = session.execute(
        select(ClipRow, ExperimentRow.config, SegmentRow.blob_key)
        .join(soonest, soonest.c.segment_id == ClipRow.segment_id)
        .join(SegmentRow, SegmentRow.id == ClipRow.segment_id)
        .join(ExperimentRow, ExperimentRow.id == ClipRow.experiment_id)
        .where(ClipRow.status == "pending", or_(ClipRow.claimed_until.is_(None), ClipRow.claimed_until <= now))
        .order_by(soonest.c.number, ClipRow.id)
        .limit(1)
        .with_for_update(of=ClipRow, skip_locked=True)
        .execution_options(populate_existing=True)
    ).first()
    if found is None:
        return None
    row, config, blob_key = found
    return PendingClip(row, str(config["task"]), blob_key)
