"""Read-only links: whoever has one reads the progress of one experiment, without an account, until it expires.

The page keeps the token in the fragment of the link, which browsers do not send: it appears in no server's log.
"""

import secrets
from datetime import timedelta

from sqlalchemy.orm import Session

from accord.domain.errors import ShareNotFound, Unauthenticated
from accord.domain.ids import new_id
from accord.services import accounts, experiments
from accord.store import shares
from accord.store.tables import ShareRow, utc_now


def create(session: Session, experiment_id: str, created_by: str, days: int) -> tuple[ShareRow, str]:
    """Creates a link; returns it with its token, which cannot be read again. Raises ExperimentNotFound."""
    experiments.get(session, experiment_id)
    now = utc_now()
    shares.remove_expired(session, now)
    token = secrets.token_urlsafe(32)
    row = ShareRow(
        id=new_id("shr"),
        hash=accounts.hash_of(token),
        experiment_id=experiment_id,
        created_by=created_by,
        created_at=now,
        expires_at=now + timedelta(days=days),
    )
    session.add(row)
    session.flush()
    return row, token


def of_experiment(session: Session, experiment_id: str) -> list[ShareRow]:
    """Links that work, newest first. Raises ExperimentNotFound."""
    experiments.get(session, experiment_id)
    return shares.of_experiment(session, experiment_id, utc_now())


def revoke(session: Session, experiment_id: str, share_id: str) -> None:
    """Deletes a link: it stops working at once. Raises ShareNotFound."""
    if not shares.remove(session, experiment_id, share_id):
        raise ShareNotFound(share_id)


def valid(session: Session, token: str) -> ShareRow:
    """The link with this token.

    Raises:
        Unauthenticated: if it is unknown, was revoked, or has expired.
    """
    row = shares.valid(session, accounts.hash_of(token), utc_now())
    if row is None:
        raise Unauthenticated("This link has expired or was revoked. Ask whoever sent it for a new one.")
    return row
