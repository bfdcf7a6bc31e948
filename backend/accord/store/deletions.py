"""Deletes every row of an experiment, and reads the records of deletions."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import ColumnElement, Table, delete, exists, func, or_, select
from sqlalchemy.orm import Session

from accord.store.tables import (
    Base,
    ClaimRow,
    ClipRow,
    ClipViewRow,
    DeletionRow,
    ExperimentRow,
    PolicyCheckpointRow,
    RecordingRow,
    RecordingViewRow,
    RewardVersionRow,
    SegmentRow,
)


def delete_rows(session: Session, experiment_id: str) -> dict[str, int]:
    """Deletes the experiment and everything that refers to it. Returns table -> number of deleted rows."""
    deleted = {
        table.name: _count(session, table, condition) for table, condition in _tables_of_experiments(experiment_id)
    }
    for table, condition in _tables_of_experiments(experiment_id):
        session.execute(delete(table).where(condition))
    session.execute(delete(ExperimentRow).where(ExperimentRow.id == experiment_id))
    return {name: count for name, count in deleted.items() if count}


@dataclass(frozen=True, slots=True)
class BlobKeys:
    """Keys that the rows of an experiment hold."""

    segments: list[str]
    checkpoints: list[str]
    #: weights of reward versions
    rewards: list[str]
    #: states of recordings
    recordings: list[str]
    #: Without those that another experiment shows too: earlier versions of Accord stored equal clips once. Videos of
    #: recordings are among them.
    clips: list[str]


def blob_keys(session: Session, experiment_id: str) -> BlobKeys:
    of_experiment = [
        select(table.blob_key).where(table.experiment_id == experiment_id)
        for table in (SegmentRow, PolicyCheckpointRow, RewardVersionRow, RecordingRow)
    ]
    return BlobKeys(
        *(list(session.scalars(statement)) for statement in of_experiment),
        clips=[
            key
            for table in (ClipRow, ClipViewRow, RecordingViewRow)
            for key in _own_clips(session, table, experiment_id)
        ],
    )


def _own_clips(
    session: Session, table: type[ClipRow | ClipViewRow | RecordingViewRow], experiment_id: str
) -> list[str]:
    """Blobs of clips that no other experiment shows."""
    shared = select(table.blob_key).where(table.experiment_id != experiment_id, table.blob_key.is_not(None))
    own = select(table.blob_key).where(
        table.experiment_id == experiment_id, table.blob_key.is_not(None), table.blob_key.not_in(shared)
    )
    return [key for key in session.scalars(own) if key is not None]


def is_claimed(session: Session, experiment_id: str, now: datetime) -> bool:
    """Whether a worker is working on the experiment or rendering one of its clips."""
    claims = exists().where(ClaimRow.subject.endswith(f":{experiment_id}", autoescape=True), ClaimRow.expires_at > now)
    rendered = [
        exists().where(table.experiment_id == experiment_id, table.status == "pending", table.claimed_until > now)
        for table in (ClipRow, ClipViewRow, RecordingViewRow)
    ]
    return bool(session.scalar(select(or_(claims, *rendered))))


def newest(session: Session, limit: int) -> list[DeletionRow]:
    """Records of deletions, newest first."""
    return list(session.scalars(select(DeletionRow).order_by(DeletionRow.id.desc()).limit(limit)))


def _tables_of_experiments(experiment_id: str) -> Iterator[tuple[Table, ColumnElement[bool]]]:
    """Every table with rows of experiments, and the condition of those of this one; referring tables come first."""
    for table in reversed(Base.metadata.sorted_tables):
        if "experiment_id" in table.c:
            yield table, table.c.experiment_id == experiment_id
            continue
        for key in table.foreign_keys:
            owner = key.column.table
            if "experiment_id" in owner.c:
                yield table, key.parent.in_(select(key.column).where(owner.c.experiment_id == experiment_id))
                break


def _count(session: Session, table: Table, condition: ColumnElement[bool]) -> int:
    return session.scalar(select(func.count()).select_from(table).where(condition)) or 0
