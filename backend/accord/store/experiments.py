"""Rows of experiments."""

from collections.abc import Sequence

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from accord.store.tables import ExperimentRow, LabelRow, QueryRow, RewardVersionRow


def get(session: Session, experiment_id: str) -> ExperimentRow | None:
    return session.get(ExperimentRow, experiment_id)


def lock(session: Session, experiment_id: str) -> ExperimentRow | None:
    """The row, newly read; nobody else changes it before this transaction ends."""
    return session.get(ExperimentRow, experiment_id, with_for_update=True, populate_existing=True)


def by_name(session: Session, name: str) -> ExperimentRow | None:
    return session.scalar(select(ExperimentRow).where(ExperimentRow.name == name))


def newest(session: Session, limit: int, before_id: str | None) -> list[ExperimentRow]:
    """Newest first; identifiers sort by time of making."""
    statement = select(ExperimentRow).order_by(ExperimentRow.id.desc()).limit(limit)
    if before_id is not None:
        statement = statement.where(ExperimentRow.id < before_id)
    return list(session.scalars(statement))


def with_status(session: Session, status: str) -> list[ExperimentRow]:
    return list(session.scalars(select(ExperimentRow).where(ExperimentRow.status == status).order_by(ExperimentRow.id)))


def advance_revision(session: Session, experiment_id: str, label_delta: int) -> int:
    """Takes the next label revision and moves the count of labels with it, in one statement.

    The row stays locked until the transaction ends, so revisions are committed in their own order: a reader that has
    seen revision n has seen every one before it.
    """
    revision = session.scalar(
        update(ExperimentRow)
        .where(ExperimentRow.id == experiment_id)
        .values(
            label_revision=ExperimentRow.label_revision + 1,
            label_count=ExperimentRow.label_count + label_delta,
        )
        .returning(ExperimentRow.label_revision)
        .execution_options(synchronize_session=False)
    )
    if revision is None:
        raise LookupError(experiment_id)
    return revision


def query_counts(
    session: Session, experiment_ids: Sequence[str], statuses: Sequence[str]
) -> dict[tuple[str, str], int]:
    """(experiment id, query status) -> queries."""
    rows = session.execute(
        select(QueryRow.experiment_id, QueryRow.status, func.count())
        .where(QueryRow.experiment_id.in_(experiment_ids), QueryRow.status.in_(statuses))
        .group_by(QueryRow.experiment_id, QueryRow.status)
    )
    return {(experiment_id, status): count for experiment_id, status, count in rows}


def skip_counts(session: Session, experiment_ids: Sequence[str]) -> dict[str, int]:
    """Experiment id -> labels that are skips."""
    rows = session.execute(
        select(LabelRow.experiment_id, func.count())
        .where(LabelRow.experiment_id.in_(experiment_ids), LabelRow.state == "skip")
        .group_by(LabelRow.experiment_id)
    )
    return dict(rows.tuples().all())


def reward_numbers(session: Session, experiment_ids: Sequence[str]) -> dict[str, int]:
    """Experiment id -> number of its newest reward version."""
    rows = session.execute(
        select(RewardVersionRow.experiment_id, func.max(RewardVersionRow.number))
        .where(RewardVersionRow.experiment_id.in_(experiment_ids))
        .group_by(RewardVersionRow.experiment_id)
    )
    return dict(rows.tuples().all())
