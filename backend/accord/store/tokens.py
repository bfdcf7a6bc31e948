"""Rows of bearer tokens, as their users list and revoke them."""

from datetime import datetime

from sqlalchemy import delete, or_, select
from sqlalchemy.orm import Session

from accord.store.tables import TokenRow

_BEARER = TokenRow.kind == "bearer"


def of_user(session: Session, user_id: str, now: datetime) -> list[TokenRow]:
    """A user's tokens that have not expired, newest first."""
    valid = or_(TokenRow.expires_at.is_(None), TokenRow.expires_at > now)
    return list(
        session.scalars(
            select(TokenRow)
            .where(TokenRow.user_id == user_id, _BEARER, valid)
            .order_by(TokenRow.created_at.desc(), TokenRow.hash)
        )
    )


def remove(session: Session, user_id: str, hash_prefix: str) -> TokenRow | None:
    """Deletes a user's token and returns it; None if there is no such token."""
    found = session.scalar(
        select(TokenRow).where(TokenRow.hash.startswith(hash_prefix), TokenRow.user_id == user_id, _BEARER)
    )
    if found is not None:
        session.execute(delete(TokenRow).where(TokenRow.hash == found.hash))
    return found
