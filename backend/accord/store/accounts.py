"""Rows of users and their tokens."""

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import bindparam, delete, or_, select, update
from sqlalchemy.orm import Session

from accord.store.tables import TokenRow, UserRow

#: built once: it is run with every request
_SIGNED_IN = (
    select(UserRow.id, UserRow.name, UserRow.role)
    .join(TokenRow, TokenRow.user_id == UserRow.id)
    .where(
        TokenRow.hash == bindparam("hash"),
        TokenRow.kind != "link",
        or_(TokenRow.expires_at.is_(None), TokenRow.expires_at > bindparam("now")),
    )
)


@dataclass(frozen=True, slots=True)
class User:
    """A signed-in user."""

    id: str
    name: str
    role: str


def user(session: Session, user_id: str) -> UserRow | None:
    return session.get(UserRow, user_id)


def user_by_name(session: Session, name: str) -> UserRow | None:
    return session.scalar(select(UserRow).where(UserRow.name == name))


def first_with_role(session: Session, role: str) -> UserRow | None:
    return session.scalar(select(UserRow).where(UserRow.role == role).order_by(UserRow.id).limit(1))


def user_of_token(session: Session, token_hash: str, now: datetime) -> User | None:
    """The user whose bearer or session token has this hash and has not expired."""
    found = session.connection().execute(_SIGNED_IN, {"hash": token_hash, "now": now}).first()
    return None if found is None else User(*found)


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
