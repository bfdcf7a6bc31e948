"""Rows of whom an OpenID Connect provider signs in."""

from sqlalchemy import select
from sqlalchemy.orm import Session

from accord.store.tables import IdentityRow, UserRow


def user_of(session: Session, issuer: str, subject: str) -> UserRow | None:
    """None if nobody has signed in with this identity."""
    return session.scalar(
        select(UserRow).join(IdentityRow).where(IdentityRow.issuer == issuer, IdentityRow.subject == subject)
    )


def add(session: Session, issuer: str, subject: str, user_id: str) -> None:
    """Adds the identity of a user."""
    session.add(IdentityRow(issuer=issuer, subject=subject, user_id=user_id))
    session.flush()
