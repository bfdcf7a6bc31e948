"""Rows of labels. Their writing is in `accord.services.label`, where the rules are."""

from dataclasses import dataclass

from sqlalchemy import func, select
from sqlalchemy.orm import Session, aliased

from accord.store.tables import LabelRow, QueryRow, SegmentRow


@dataclass(frozen=True, slots=True)
class LabelledPair:
    """A label with the two segments it compares."""

    query_id: str
    segment_0_id: str
    segment_1_id: str
    segment_0_blob: str
    segment_1_blob: str
    #: P(segment 0 is preferred)
    value: float


def count_after(session: Session, experiment_id: str, revision: int) -> int:
    """Labels that count and were written or changed after a revision."""
    return (
        session.scalar(
            select(func.count())
            .select_from(LabelRow)
            .where(LabelRow.experiment_id == experiment_id, LabelRow.revision > revision, LabelRow.state == "label")
        )
        or 0
    )


def up_to(session: Session, experiment_id: str, revision: int) -> list[LabelledPair]:
    """Labels that count, with a revision up to this one, in the order of their queries."""
    segment_0, segment_1 = aliased(SegmentRow), aliased(SegmentRow)
    rows = session.execute(
        select(
            QueryRow.id,
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
        .order_by(QueryRow.number, LabelRow.id)
    )
    return [LabelledPair(*row) for row in rows]
