"""Rows of reward versions and policy checkpoints."""

from dataclasses import dataclass

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from accord.store.tables import LabellerReliabilityRow, PolicyCheckpointRow, RewardVersionRow, UserRow


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


@dataclass(frozen=True, slots=True)
class NamedReliability:
    """The reliability of a labeller, with the name."""

    row: LabellerReliabilityRow
    user_name: str


def reliabilities(session: Session, version_id: str) -> list[NamedReliability]:
    """By name."""
    rows = session.execute(
        select(LabellerReliabilityRow, UserRow.name)
        .join(UserRow, UserRow.id == LabellerReliabilityRow.user_id)
        .where(LabellerReliabilityRow.reward_version_id == version_id)
        .order_by(UserRow.name)
    )
    return [NamedReliability(row, name) for row, name in rows]


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
