"""Rows of labels and of their history. `accord.services.label` decides who may write one."""

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import bindparam, func, insert, select, update
from sqlalchemy.orm import Session, aliased

from accord.store.queries import Response
from accord.store.tables import ExperimentRow, LabelRevisionRow, LabelRow, QueryRow, SegmentRow

#: built once, as in `queries`
_ADVANCE = (
    update(ExperimentRow)
    .where(ExperimentRow.id == bindparam("experiment"))
    .values(
        label_revision=ExperimentRow.label_revision + 1,
        label_count=ExperimentRow.label_count + bindparam("delta"),
    )
    .returning(ExperimentRow.label_revision)
)
_INSERT = insert(LabelRow)
_UPDATE = update(LabelRow).where(LabelRow.id == bindparam("label"))
_INSERT_REVISION = insert(LabelRevisionRow)


@dataclass(frozen=True, slots=True)
class StoredLabel:
    """A teacher's current label, skip or undo on a query."""

    id: str
    experiment_id: str
    query_id: str
    user_id: str
    value: float | None
    state: str
    revision: int
    left_segment: int | None


@dataclass(frozen=True, slots=True)
class LabelledPair:
    """A label with the two segments it compares."""

    query_id: str
    #: of the query within the experiment
    query_number: int
    segment_0_id: str
    segment_1_id: str
    segment_0_blob: str
    segment_1_blob: str
    #: P(segment 0 is preferred)
    value: float


def advance_revision(session: Session, experiment_id: str, label_delta: int) -> int:
    """Increments the label revision and adds to the number of labels, in one statement.

    The row stays locked until the transaction ends, so that revisions are committed in order: a reader that sees
    revision n sees all before it.
    """
    return session.connection().execute(_ADVANCE, {"experiment": experiment_id, "delta": label_delta}).scalar_one()


def write(session: Session, label: StoredLabel, response: Response, now: datetime, *, new: bool) -> None:
    """Inserts a `new` label or updates an existing one, and adds it to the history."""
    connection = session.connection()
    content = {
        "value": response.value,
        "state": response.state,
        "left_segment": response.left_segment,
        "response_seconds": response.response_seconds,
        "revision": label.revision,
    }
    newest = content | {"teacher": response.teacher, "updated_at": now}
    if new:
        author = {"experiment_id": label.experiment_id, "query_id": label.query_id, "user_id": label.user_id}
        connection.execute(_INSERT, newest | author | {"id": label.id, "created_at": now})
    else:
        connection.execute(_UPDATE, newest | {"label": label.id})
    connection.execute(
        _INSERT_REVISION, content | {"experiment_id": label.experiment_id, "label_id": label.id, "created_at": now}
    )


def count_after(session: Session, experiment_id: str, revision: int) -> int:
    """Number of labels (no skips) written or changed after a revision."""
    statement = select(func.count()).where(
        LabelRow.experiment_id == experiment_id, LabelRow.revision > revision, LabelRow.state == "label"
    )
    return session.scalar(statement) or 0


def up_to(session: Session, experiment_id: str, revision: int) -> list[LabelledPair]:
    """Labels (no skips) up to a revision, in the order in which they were first given."""
    segment_0, segment_1 = aliased(SegmentRow), aliased(SegmentRow)
    rows = session.execute(
        select(
            QueryRow.id,
            QueryRow.number,
            QueryRow.segment_0_id,
            QueryRow.segment_1_id,
            segment_0.blob_key,
            segment_1.blob_key,
            LabelRow.value,
        )
        .select_from(LabelRow)
        .join(QueryRow, QueryRow.id == LabelRow.query_id)
        .join(segment_0, segment_0.id == QueryRow.segment_0_id)
        .join(segment_1, segment_1.id == QueryRow.segment_1_id)
        .where(LabelRow.experiment_id == experiment_id, LabelRow.revision <= revision, LabelRow.state == "label")
        .order_by(LabelRow.created_at, LabelRow.id)
    )
    return [LabelledPair(*row) for row in rows]
