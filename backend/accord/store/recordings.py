"""Rows of recordings of policies, and their views."""

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from accord.store.tables import RecordingRow, RecordingViewRow, RewardVersionRow


@dataclass(frozen=True, slots=True)
class NumberedRecording:
    """A recording, with the number of its reward version."""

    row: RecordingRow
    reward_version: int | None


def lock(session: Session, recording_id: str) -> RecordingRow | None:
    return session.get(RecordingRow, recording_id, with_for_update=True, populate_existing=True)


def of_experiment(session: Session, experiment_id: str) -> list[NumberedRecording]:
    """By steps of the policy."""
    rows = session.execute(
        select(RecordingRow, RewardVersionRow.number)
        .outerjoin(RewardVersionRow, RewardVersionRow.id == RecordingRow.reward_version_id)
        .where(RecordingRow.experiment_id == experiment_id)
        .order_by(RecordingRow.policy_steps)
    )
    return [NumberedRecording(row, number) for row, number in rows]


def ready_views(session: Session, experiment_id: str) -> list[tuple[str, str]]:
    """(recording id, camera) of every rendered video."""
    rows = session.execute(
        select(RecordingViewRow.recording_id, RecordingViewRow.camera)
        .where(RecordingViewRow.experiment_id == experiment_id, RecordingViewRow.status == "ready")
        .order_by(RecordingViewRow.recording_id, RecordingViewRow.camera)
    )
    return [(recording_id, camera) for recording_id, camera in rows]


def delete_rows(session: Session, recording_ids: Sequence[str]) -> list[str]:
    """Deletes recordings and their views. Returns the keys of their blobs."""
    videos = session.scalars(
        delete(RecordingViewRow)
        .where(RecordingViewRow.recording_id.in_(recording_ids))
        .returning(RecordingViewRow.blob_key)
    ).all()
    states = session.scalars(
        delete(RecordingRow).where(RecordingRow.id.in_(recording_ids)).returning(RecordingRow.blob_key)
    ).all()
    return [*states, *(key for key in videos if key is not None)]
