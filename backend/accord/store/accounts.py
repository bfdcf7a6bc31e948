"""Rows of users and their tokens."""

from datetime import datetime

from sqlalchemy import delete, or_, select, update
from sqlalchemy.orm import Session

from accord.store.tables import TokenRow, UserRow


def user(session: Session, user_id: str) -> UserRow | None:
    return session.get(UserRow, user_id)


def user_by_name(session: Session, name: str) -> UserRow | None:
    return session.scalar(select(UserRow).where(UserRow.name == name))


def first_with_role(session: Session, role: str) -> UserRow | None:
    return session.scalar(select(UserRow).where(UserRow.role == role).order_by(UserRow.id).limit(1))


def user_of_token(session: Session, token_hash: str, kinds: tuple[str, ...], now: datetime) -> UserRow | None:
    """The user whose unexpired token has this hash."""
    return session.scalar(
        select(UserRow)
        .join(TokenRow, TokenRow.user_id == UserRow.id)
        .where(
            TokenRow.hash == token_hash,
            TokenRow.kind.in_(kinds),
            or_(TokenRow.expires_at.is_(None), TokenRow.expires_at > now),
        )
    )


def use_link(session: Session, token_hash: str, now: datetime) -> str | None:
    """Marks a link as used and returns its user's id; None when there is none, or it is used or expired.

    One conditional update, so that of two browsers that open a link at once only one is signed in.
    """
    return session.scalar(
        update(TokenRow)
        .where(
            TokenRow.hash == token_hash,
            TokenRow.kind == "link",
            TokenRow.used_at.is_(None),
            TokenRow.expires_at > now,
        )
        .values(used_at=now)
        .returning(TokenRow.user_id)
    )


def delete_token(session: Session, token_hash: str) -> None:
    session.execute(delete(TokenRow).where(TokenRow.hash == token_hash))


def delete_expired(session: Session, now: datetime) -> None:
    session.execute(delete(TokenRow).where(TokenRow.expires_at <= now))
