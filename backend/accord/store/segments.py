"""Rows of segments."""

from collections.abc import Sequence

from sqlalchemy import exists, select
from sqlalchemy.orm import Session

from accord.store.tables import ClipRow, QueryRow, SegmentRow


def get(session: Session, segment_id: str) -> SegmentRow | None:
    return session.get(SegmentRow, segment_id)


def newest(session: Session, experiment_id: str, limit: int) -> list[tuple[str, int]]:
    """(segment id, policy steps), newest first."""
    rows = session.execute(
        select(SegmentRow.id, SegmentRow.policy_steps)
        .where(SegmentRow.experiment_id == experiment_id)
        .order_by(SegmentRow.policy_steps.desc(), SegmentRow.id.desc())
        .limit(limit)
    )
    return [(segment_id, steps) for segment_id, steps in rows]


def newest_with_clips(session: Session, experiment_id: str, limit: int | None) -> list[str]:
    """Ids of segments whose clip did not fail, newest first; at most `limit` of them."""
    failed = exists().where(ClipRow.segment_id == SegmentRow.id, ClipRow.status == "failed")
    return list(
        session.scalars(
            select(SegmentRow.id)
            .where(SegmentRow.experiment_id == experiment_id, ~failed)
            .order_by(SegmentRow.policy_steps.desc(), SegmentRow.id.desc())
            .limit(limit)
        )
    )


def blob_keys_without_query(session: Session, experiment_id: str) -> list[str]:
    """Blob keys of the segments that are in no query, oldest first."""
    queried = exists().where(
        QueryRow.experiment_id == experiment_id,
        (QueryRow.segment_0_id == SegmentRow.id) | (QueryRow.segment_1_id == SegmentRow.id),
    )
    return list(
        session.scalars(
            select(SegmentRow.blob_key)
            .where(SegmentRow.experiment_id == experiment_id, ~queried)
            .order_by(SegmentRow.policy_steps, SegmentRow.id)
        )
    )


def of_experiment(session: Session, experiment_id: str, segment_ids: Sequence[str]) -> set[str]:
    """The subset of the ids that are segments of the experiment."""
    return set(
        session.scalars(
            select(SegmentRow.id).where(SegmentRow.experiment_id == experiment_id, SegmentRow.id.in_(segment_ids))
        )
    )


def blob_keys(session: Session, segment_ids: Sequence[str]) -> dict[str, str]:
    """Segment id -> blob key."""
    rows = session.execute(select(SegmentRow.id, SegmentRow.blob_key).where(SegmentRow.id.in_(segment_ids)))
    return dict(rows.all())
