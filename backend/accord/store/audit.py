"""Rows of the audit log."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session, aliased

from accord.store.tables import AuditRow, ExperimentRow, UserRow


@dataclass(frozen=True, slots=True)
class AuditFilters:
    """Which entries to list; None does not filter."""

    action: str | None = None
    actor_id: str | None = None
    subject_id: str | None = None
    since: datetime | None = None
    until: datetime | None = None


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """An entry with the names that its ids have now."""

    id: str
    action: str
    actor_id: str | None
    #: None for a command on the server, for somebody who was not signed in, and for a user who was deleted
    actor_name: str | None
    subject_id: str | None
    #: of a user or an experiment that still exists
    subject_name: str | None
    detail: dict[str, Any]
    created_at: datetime


def newest(session: Session, filters: AuditFilters, limit: int, before_id: str | None) -> list[AuditEntry]:
    """Newest first; identifiers sort by time of creation."""
    actor, subject = aliased(UserRow), aliased(UserRow)
    statement = (
        select(AuditRow, actor.name, subject.name, ExperimentRow.name)
        .outerjoin(actor, actor.id == AuditRow.actor_id)
        .outerjoin(subject, subject.id == AuditRow.subject_id)
        .outerjoin(ExperimentRow, ExperimentRow.id == AuditRow.subject_id)
        .order_by(AuditRow.id.desc())
        .limit(limit)
    )
    for column, wanted in (
        (AuditRow.action, filters.action),
        (AuditRow.actor_id, filters.actor_id),
        (AuditRow.subject_id, filters.subject_id),
    ):
        if wanted is not None:
            statement = statement.where(column == wanted)
    if filters.since is not None:
        statement = statement.where(AuditRow.created_at >= filters.since)
    if filters.until is not None:
        statement = statement.where(AuditRow.created_at < filters.until)
    if before_id is not None:
        statement = statement.where(AuditRow.id < before_id)
    return [
        AuditEntry(
            id=row.id,
            action=row.action,
            actor_id=row.actor_id,
            actor_name=actor_name,
            subject_id=row.subject_id,
            subject_name=user_name or experiment_name,
            detail=row.detail,
            created_at=row.created_at,
        )
        for row, actor_name, user_name, experiment_name in session.execute(statement)
    ]
