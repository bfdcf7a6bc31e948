"""Sums over the rows of an experiment."""

from dataclasses import dataclass

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from accord.store.tables import ClipRow, LabelRow, MetricRow, SegmentRow


@dataclass(frozen=True, slots=True)
class Answers:
    """Labels and skips of an experiment."""

    by_people: int
    people: int
    #: seconds of those with a measured time
    person_seconds: float
    #: labels without skips
    by_programs: int


def answers(session: Session, experiment_id: str) -> Answers:
    """Answers of people, which the page showed on a side, and of programs, which it did not."""
    shown = LabelRow.left_segment.is_not(None)
    given = LabelRow.experiment_id == experiment_id, LabelRow.state.in_(("label", "skip"))
    by_people, people, seconds = session.execute(
        select(func.count(), func.count(LabelRow.user_id.distinct()), func.sum(LabelRow.response_seconds)).where(
            *given, shown
        )
    ).one()
    by_programs = session.scalar(
        select(func.count()).select_from(LabelRow).where(*given, ~shown, LabelRow.state == "label")
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


def sum_of_inverses(session: Session, experiment_id: str, metric: str) -> float:
    """Sum of 1 / value over the points of a curve."""
    points = select(func.coalesce(func.sum(1.0 / MetricRow.value), 0)).where(
        MetricRow.experiment_id == experiment_id, MetricRow.name == metric, MetricRow.value > 0
    )
    return float(session.scalar(points) or 0)
