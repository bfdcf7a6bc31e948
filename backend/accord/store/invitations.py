"""Rows of invitations."""

from datetime import datetime

from sqlalchemy import ColumnElement, delete, select, update
from sqlalchemy.orm import Session

from accord.store.tables import InvitationRow


def newest(session: Session) -> list[InvitationRow]:
    """Every invitation, newest first."""
    return list(session.scalars(select(InvitationRow).order_by(InvitationRow.id.desc())))


def valid(session: Session, token_hash: str, now: datetime) -> InvitationRow | None:
    """The invitation whose token has this hash, if it has uses left and has not expired."""
    return session.scalar(select(InvitationRow).where(*_is_valid(token_hash, now)))


def use(session: Session, token_hash: str, now: datetime) -> tuple[str | None] | None:
    """Counts one use of a valid invitation, and returns its experiment; None if it is not valid.

    One conditional update, so that two browsers cannot share the last use.
    """
    statement = (
        update(InvitationRow)
        .where(*_is_valid(token_hash, now))
        .values(uses=InvitationRow.uses + 1)
        .returning(InvitationRow.experiment_id)
    )
    found = session.execute(statement).first()
    return None if found is None else (found[0],)


def remove(session: Session, invitation_id: str) -> bool:
    """Deletes an invitation. Returns whether it existed."""
    removed = session.scalar(delete(InvitationRow).where(InvitationRow.id == invitation_id).returning(InvitationRow.id))
    return removed is not None


def _is_valid(token_hash: str, now: datetime) -> tuple[ColumnElement[bool], ...]:
    return (
        InvitationRow.hash == token_hash,
        InvitationRow.uses < InvitationRow.max_uses,
        InvitationRow.expires_at > now,
    )
