"""Rows of clips from other cameras."""

from datetime import datetime

from sqlalchemy import or_, select
from sqlalchemy.orm import Session

from accord.store.tables import ClipViewRow


def get(session: Session, clip_id: str, camera: str) -> ClipViewRow | None:
    return session.get(ClipViewRow, (clip_id, camera))


def lock(session: Session, clip_id: str, camera: str) -> ClipViewRow | None:
    return session.get(ClipViewRow, (clip_id, camera), with_for_update=True, populate_existing=True)


def lock_pending(session: Session, now: datetime) -> ClipViewRow | None:
    """Locks the unclaimed view that was requested last: somebody may still be looking at its pair."""
    return session.scalars(
        select(ClipViewRow)
        .where(
            ClipViewRow.status == "pending", or_(ClipViewRow.claimed_until.is_(None), ClipViewRow.claimed_until <= now)
        )
        .order_by(ClipViewRow.requested_at.desc(), ClipViewRow.clip_id)
        .limit(1)
        .with_for_update(skip_locked=True)
        .execution_options(populate_existing=True)
    ).first()
