"""The audit log: who did what, and when. An entry is written in the transaction of what it records, or not at all."""

from sqlalchemy.orm import Session

from accord.domain.enums import AuditAction
from accord.domain.ids import new_id
from accord.store import audit
from accord.store.accounts import User
from accord.store.audit import AuditEntry, AuditFilters
from accord.store.tables import AuditRow, UserRow


def record(
    session: Session, actor: User | UserRow | None, action: AuditAction, subject_id: str | None = None, **detail: object
) -> None:
    """Adds an entry.

    Args:
        actor: who did it; None for a command on the server, and for somebody who was not signed in.
        subject_id: what it was done to.
        detail: JSON values, without secrets and names of people.
    """
    actor_id = None if actor is None else actor.id
    session.add(
        AuditRow(id=new_id("aud"), action=action.value, actor_id=actor_id, subject_id=subject_id, detail=detail)
    )
    session.flush()


def listed(
    session: Session, filters: AuditFilters, limit: int, before_id: str | None
) -> tuple[list[AuditEntry], str | None]:
    """Entries, newest first, and the id before which the next page begins; None at the end."""
    found = audit.newest(session, filters, limit + 1, before_id)
    return found[:limit], found[limit - 1].id if len(found) > limit else None
