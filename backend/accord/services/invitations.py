"""Invitations: links with which people create their own labeller accounts.

Opening a link uses nothing up, so that previews of links in chats and mail programs are harmless. Whoever enters a name
and confirms it becomes a new labeller, until the link expires or has no uses left.
"""

import secrets
from datetime import timedelta

from sqlalchemy.orm import Session

from accord.domain.enums import Role
from accord.domain.errors import InvitationNotFound, InvitationNotValid, NameTaken
from accord.domain.ids import new_id
from accord.services import access, accounts, experiments
from accord.services.validation import check_line
from accord.store import invitations
from accord.store.tables import InvitationRow, UserRow, utc_now


def create(
    session: Session, admin_name: str, *, experiment_id: str | None, max_uses: int, days: float
) -> tuple[InvitationRow, str]:
    """Creates an invitation; returns it with its token, which cannot be read again.

    Args:
        experiment_id: the only experiment that its labellers will see; None for all.

    Raises:
        ExperimentNotFound: if there is no such experiment.
    """
    if experiment_id is not None:
        experiments.get(session, experiment_id)
    token = secrets.token_urlsafe(32)
    now = utc_now()
    row = InvitationRow(
        id=new_id("inv"),
        hash=accounts.hash_of(token),
        experiment_id=experiment_id,
        max_uses=max_uses,
        created_by=admin_name,
        created_at=now,
        expires_at=now + timedelta(days=days),
    )
    session.add(row)
    session.flush()
    return row, token


def listed(session: Session) -> list[InvitationRow]:
    """Every invitation, newest first, also those that are used up or have expired."""
    return invitations.newest(session)


def withdraw(session: Session, invitation_id: str) -> None:
    """Deletes an invitation. Those who have joined by it stay. Raises InvitationNotFound."""
    if not invitations.remove(session, invitation_id):
        raise InvitationNotFound(invitation_id)


def valid(session: Session, token: str) -> InvitationRow:
    """The invitation with this token. Uses nothing up. Raises InvitationNotValid."""
    row = invitations.valid(session, accounts.hash_of(token), utc_now())
    if row is None:
        raise InvitationNotValid
    return row


def join(session: Session, token: str, name: str, session_days: float) -> tuple[UserRow, str]:
    """Creates a labeller by an invitation; returns it with the token of a new browser session.

    Raises:
        InvitationNotValid: if the invitation is unknown or withdrawn, has expired, or has no uses left.
        Invalid: if the name is empty or contains characters that are not printable.
        NameTaken: if another user has this name; the use is not counted.
    """
    line = check_line(name, "name", 100)
    used = invitations.use(session, accounts.hash_of(token), utc_now())
    if used is None:
        raise InvitationNotValid
    if accounts.name_is_taken(session, line):
        raise NameTaken(
            f"Somebody named {line!r} is here already. Choose another name; or, if it is you, ask for a new sign-in "
            "link instead."
        )
    user = accounts.add_row(session, line, Role.LABELLER)
    (experiment_id,) = used
    if experiment_id is not None:
        access.limit(session, user, all_experiments=False, experiment_ids=[experiment_id])
    return user, accounts.start_session(session, user, session_days)
