"""Rows of reward versions and policy checkpoints."""

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from accord.store.tables import PolicyCheckpointRow, RewardVersionRow


def versions(session: Session, experiment_id: str) -> list[RewardVersionRow]:
    """Oldest first."""
    return list(
        session.scalars(
            select(RewardVersionRow)
            .where(RewardVersionRow.experiment_id == experiment_id)
            .order_by(RewardVersionRow.number)
        )
    )


def newest_version(session: Session, experiment_id: str) -> RewardVersionRow | None:
    return session.scalar(
        select(RewardVersionRow)
        .where(RewardVersionRow.experiment_id == experiment_id)
        .order_by(RewardVersionRow.number.desc())
        .limit(1)
    )


def checkpoints(session: Session, experiment_id: str, limit: int) -> list[PolicyCheckpointRow]:
    """Newest first."""
    return list(
        session.scalars(
            select(PolicyCheckpointRow)
            .where(PolicyCheckpointRow.experiment_id == experiment_id)
            .order_by(PolicyCheckpointRow.steps.desc(), PolicyCheckpointRow.id.desc())
            .limit(limit)
        )
    )


def delete_checkpoints_but(session: Session, experiment_id: str, kept_ids: list[str]) -> list[str]:
    """Removes all other checkpoints' rows and returns the keys of their blobs."""
    return list(
        session.scalars(
            delete(PolicyCheckpointRow)
            .where(PolicyCheckpointRow.experiment_id == experiment_id, PolicyCheckpointRow.id.not_in(kept_ids))
            .returning(PolicyCheckpointRow.blob_key)
        )
    )
