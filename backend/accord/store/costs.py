"""Sums over the rows of an experiment."""

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from accord.store.tables import ClipRow, LabelRow, SegmentRow


@dataclass(frozen=True, slots=True)
class Answers:
    """Labels and skips of an experiment."""

    by_people: int
    people: int
    person_seconds: float
    #: labels without skips
    by_programs: int


def answers(session: Session, experiment_id: str, since: datetime) -> Answers:
    """Answers of people, whose time the page measures, and of programs, which send none.

    Args:
        since: the experiment's creation. Answers that are not newer were imported: they are a cost of the experiment
            that they were given to.
    """
    measured = LabelRow.response_seconds.is_not(None)
    given = (
        LabelRow.experiment_id == experiment_id,
        LabelRow.state.in_(("label", "skip")),
        LabelRow.created_at > since,
    )
    by_people, people, seconds = session.execute(
        select(func.count(), func.count(LabelRow.user_id.distinct()), func.sum(LabelRow.response_seconds)).where(
            *given, measured
        )
    ).one()
    by_programs = session.scalar(
        select(func.count()).select_from(LabelRow).where(*given, ~measured, LabelRow.state == "label")
    )
    return Answers(by_people, people, seconds or 0.0, by_programs or 0)


def clips(session: Session, experiment_id: str) -> tuple[int, int]:
    """Number and bytes of the rendered clips."""
    rendered = select(func.count(), func.coalesce(func.sum(ClipRow.size_bytes), 0)).where(
        ClipRow.experiment_id == experiment_id, ClipRow.blob_key.is_not(None)
    )
    count, size = session.execute(rendered).one()
    return count, int(size)


def segments(session: Session, experiment_id: str) -> int:
    found = select(func.count()).select_from(SegmentRow).where(SegmentRow.experiment_id == experiment_id)
    return session.scalar(found) or 0
