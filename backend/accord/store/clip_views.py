"""Rows of videos that somebody asked for: clips from other cameras, and recordings of policies."""

from datetime import datetime
from typing import TypeVar

from sqlalchemy import Select, or_, select
from sqlalchemy.orm import Session

from accord.store.tables import ClipViewRow, RecordingViewRow

ViewRow = ClipViewRow | RecordingViewRow
Row = TypeVar("Row", bound=ViewRow)


def get(session: Session, table: type[Row], shown_id: str, camera: str) -> Row | None:
    """
    Args:
        shown_id: of the clip or the recording.
    """
    return session.get(table, (shown_id, camera))


def lock(session: Session, table: type[Row], shown_id: str, camera: str) -> Row | None:
    """As `get`, with a lock."""
    return session.get(table, (shown_id, camera), with_for_update=True, populate_existing=True)


def is_pending(session: Session, now: datetime) -> bool:
    """Whether `lock_pending` would find a view. Only reads."""
    return any(
        session.scalars(_newest_pending(table, now)).first() is not None for table in (ClipViewRow, RecordingViewRow)
    )


def lock_pending(session: Session, now: datetime) -> ViewRow | None:
    """Locks the unclaimed view that was requested last: somebody may still be looking at it.

    Views of clips come first, because labellers wait for them.
    """
    return _lock_newest(session, ClipViewRow, now) or _lock_newest(session, RecordingViewRow, now)


def _lock_newest(session: Session, table: type[Row], now: datetime) -> Row | None:
    statement = _newest_pending(table, now).with_for_update(skip_locked=True)
    return session.scalars(statement.execution_options(populate_existing=True)).first()


def _newest_pending(table: type[Row], now: datetime) -> Select[Row]:
    return (
        select(table)
        .where(table.status == "pending", or_(table.claimed_until.is_(None), table.claimed_until <= now))
        .order_by(table.requested_at.desc())
        .limit(1)
    )
