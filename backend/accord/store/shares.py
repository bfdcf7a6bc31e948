"""Rows of read-only links."""

from datetime import datetime

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from accord.store.tables import ShareRow


def of_experiment(session: Session, experiment_id: str, now: datetime) -> list[ShareRow]:
    """Links that have not expired, newest first."""
    return list(
        session.scalars(
            select(ShareRow)
            .where(ShareRow.experiment_id == experiment_id, ShareRow.expires_at > now)
            .order_by(ShareRow.id.desc())
        )
    )


def valid(session: Session, token_hash: str, now: datetime) -> ShareRow | None:
    """The link whose token has this hash, if it has not expired."""
    return session.scalar(select(ShareRow).where(ShareRow.hash == token_hash, ShareRow.expires_at > now))


def remove(session: Session, experiment_id: str, share_id: str) -> bool:
    """Deletes a link. Returns whether the experiment had it."""
    statement = delete(ShareRow).where(ShareRow.id == share_id, ShareRow.experiment_id == experiment_id)
    return session.scalar(statement.returning(ShareRow.id)) is not None


def remove_expired(session: Session, now: datetime) -> None:
    session.execute(delete(ShareRow).where(ShareRow.expires_at <= now))
