"""Rows of experiments."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import bindparam, func, select
from sqlalchemy.orm import Session, aliased

from accord.store.tables import ExperimentRow, LabelRow, QueryRow, RewardVersionRow


@dataclass(frozen=True, slots=True)
class LabellingState:
    """What decides whether an experiment has queries to label."""

    status: str
    label_count: int
    config: dict[str, Any]


#: built once, because every request for the next query runs it
_LABELLING_STATE = select(ExperimentRow.status, ExperimentRow.label_count, ExperimentRow.config).where(
    ExperimentRow.id == bindparam("experiment")
)


def labelling_state(session: Session, experiment_id: str) -> LabellingState | None:
    found = session.connection().execute(_LABELLING_STATE, {"experiment": experiment_id}).first()
    return None if found is None else LabellingState(*found)


def get(session: Session, experiment_id: str) -> ExperimentRow | None:
    return session.get(ExperimentRow, experiment_id)


def lock(session: Session, experiment_id: str) -> ExperimentRow | None:
    """Reads the row again and locks it until the transaction ends."""
    return session.get(ExperimentRow, experiment_id, with_for_update=True, populate_existing=True)


def by_name(session: Session, name: str) -> ExperimentRow | None:
    return session.scalar(select(ExperimentRow).where(ExperimentRow.name == name))


def newest(session: Session, limit: int, before_id: str | None, *, archived: bool | None) -> list[ExperimentRow]:
    """Newest first; identifiers sort by time of creation. With `archived` None, archived ones and others."""
    statement = select(ExperimentRow).order_by(ExperimentRow.id.desc()).limit(limit)
    if archived is not None:
        statement = statement.where(ExperimentRow.archived_at.is_not(None) == archived)
    if before_id is not None:
        statement = statement.where(ExperimentRow.id < before_id)
    return list(session.scalars(statement))


def with_status(session: Session, status: str) -> list[ExperimentRow]:
    return list(session.scalars(select(ExperimentRow).where(ExperimentRow.status == status).order_by(ExperimentRow.id)))


def query_counts(
    session: Session, experiment_ids: Sequence[str], statuses: Sequence[str]
) -> dict[tuple[str, str], int]:
    """(experiment id, query status) -> number of queries."""
    rows = session.execute(
        select(QueryRow.experiment_id, QueryRow.status, func.count())
        .where(QueryRow.experiment_id.in_(experiment_ids), QueryRow.status.in_(statuses))
        .group_by(QueryRow.experiment_id, QueryRow.status)
    )
    return {(experiment_id, status): count for experiment_id, status, count in rows}


def skip_counts(session: Session, experiment_ids: Sequence[str]) -> dict[str, int]:
    """Experiment id -> number of skips."""
    rows = session.execute(
        select(LabelRow.experiment_id, func.count())
        .where(LabelRow.experiment_id.in_(experiment_ids), LabelRow.state == "skip")
        .group_by(LabelRow.experiment_id)
    )
    return dict(rows.all())


def newest_versions(session: Session, experiment_ids: Sequence[str]) -> dict[str, RewardVersionRow]:
    """Experiment id -> newest reward version."""
    other = aliased(RewardVersionRow)
    newest_number = (
        select(func.max(other.number)).where(other.experiment_id == RewardVersionRow.experiment_id).scalar_subquery()
    )
    rows = session.scalars(
        select(RewardVersionRow).where(
            RewardVersionRow.experiment_id.in_(experiment_ids), RewardVersionRow.number == newest_number
        )
    )
    return {row.experiment_id: row for row in rows}
