"""Rows of queries, and how they were shown."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import exists, func, insert, or_, select, update
from sqlalchemy.orm import Session, aliased

from accord.store.tables import ClipRow, LabelRow, PresentationRow, QueryRow, SegmentRow

_SEGMENT_0, _SEGMENT_1 = aliased(SegmentRow), aliased(SegmentRow)
_CLIP_0, _CLIP_1 = aliased(ClipRow), aliased(ClipRow)


@dataclass(frozen=True, slots=True)
class SideRow:
    """One segment of a query with what its clip tells."""

    segment_id: str
    blob_key: str
    length_steps: int
    true_return: float
    #: None where the experiment makes no clips
    clip_id: str | None
    clip_seconds: float | None
    clip_frames: int | None


@dataclass(frozen=True, slots=True)
class ShownQuery:
    """A query with its two segments, and the side drawn for one user."""

    query_id: str
    experiment_id: str
    number: int
    #: None before it was ever shown to this user
    left_segment: int | None
    segments: tuple[SideRow, SideRow]


@dataclass(frozen=True, slots=True)
class QueryInHand:
    """Everything that decides what a label on a query does."""

    query: QueryRow
    #: the user's own earlier word
    label: LabelRow | None
    left_segment: int | None


def lock(session: Session, query_id: str, user_id: str) -> QueryInHand | None:
    """A query with one user's label and side; nobody else changes it before this transaction ends."""
    found = session.execute(
        select(QueryRow, LabelRow, PresentationRow.left_segment)
        .outerjoin(LabelRow, (LabelRow.query_id == QueryRow.id) & (LabelRow.user_id == user_id))
        .outerjoin(PresentationRow, (PresentationRow.query_id == QueryRow.id) & (PresentationRow.user_id == user_id))
        .where(QueryRow.id == query_id)
        .with_for_update(of=QueryRow)
        .execution_options(populate_existing=True)
    ).first()
    return None if found is None else QueryInHand(found[0], found[1], found[2])


def leased_ids(session: Session, user_id: str, experiment_id: str, now: datetime, limit: int) -> list[str]:
    """Queries that a user holds an unexpired lease on, in the order of their numbers."""
    return list(
        session.scalars(
            select(QueryRow.id)
            .where(
                QueryRow.leased_by == user_id,
                QueryRow.experiment_id == experiment_id,
                QueryRow.status == "open",
                QueryRow.leased_until > now,
            )
            .order_by(QueryRow.number)
            .limit(limit)
            # an expiring lease is either still ours when locked, or not in the list
            .with_for_update()
        )
    )


def lock_free_ids(session: Session, user_id: str, experiment_id: str, now: datetime, limit: int) -> list[str]:
    """Open queries that nobody holds and the user has not skipped, lowest number first."""
    skipped = exists().where(LabelRow.query_id == QueryRow.id, LabelRow.user_id == user_id, LabelRow.state != "undone")
    return list(
        session.scalars(
            select(QueryRow.id)
            .where(
                QueryRow.experiment_id == experiment_id,
                QueryRow.status == "open",
                or_(QueryRow.leased_by.is_(None), QueryRow.leased_until <= now),
                ~skipped,
            )
            .order_by(QueryRow.number)
            .limit(limit)
            .with_for_update(skip_locked=True)
        )
    )


def lease(session: Session, query_ids: Sequence[str], user_id: str, until: datetime) -> None:
    session.execute(
        update(QueryRow)
        .where(QueryRow.id.in_(query_ids))
        .values(leased_by=user_id, leased_until=until)
        .execution_options(synchronize_session=False)
    )


def shown(session: Session, query_ids: Sequence[str], user_id: str) -> list[ShownQuery]:
    """The queries as one user sees them, in the order of their numbers."""
    columns: list[Any] = [
        QueryRow.id,
        QueryRow.experiment_id,
        QueryRow.number,
        PresentationRow.left_segment,
        *_side_columns(_SEGMENT_0, _CLIP_0),
        *_side_columns(_SEGMENT_1, _CLIP_1),
    ]
    rows: Iterable[Any] = session.execute(
        select(*columns)
        .join(_SEGMENT_0, _SEGMENT_0.id == QueryRow.segment_0_id)
        .join(_SEGMENT_1, _SEGMENT_1.id == QueryRow.segment_1_id)
        .outerjoin(_CLIP_0, (_CLIP_0.segment_id == QueryRow.segment_0_id) & (_CLIP_0.status == "ready"))
        .outerjoin(_CLIP_1, (_CLIP_1.segment_id == QueryRow.segment_1_id) & (_CLIP_1.status == "ready"))
        .outerjoin(PresentationRow, (PresentationRow.query_id == QueryRow.id) & (PresentationRow.user_id == user_id))
        .where(QueryRow.id.in_(query_ids))
        .order_by(QueryRow.number)
    )
    return [ShownQuery(row[0], row[1], row[2], row[3], (SideRow(*row[4:11]), SideRow(*row[11:18]))) for row in rows]


def add_presentations(session: Session, user_id: str, left_segments: dict[str, int], now: datetime) -> None:
    """Stores which segment is on the left, by query id."""
    session.execute(
        insert(PresentationRow),
        [
            {"query_id": query_id, "user_id": user_id, "left_segment": left, "shown_at": now}
            for query_id, left in left_segments.items()
        ],
    )


def pairs(session: Session, experiment_id: str) -> set[frozenset[str]]:
    """Every pair of segments that has a query, whichever way round."""
    rows = session.execute(
        select(QueryRow.segment_0_id, QueryRow.segment_1_id).where(QueryRow.experiment_id == experiment_id)
    )
    return {frozenset((first, second)) for first, second in rows}


def last_number(session: Session, experiment_id: str) -> int:
    return session.scalar(select(func.max(QueryRow.number)).where(QueryRow.experiment_id == experiment_id)) or 0


def count_standing(session: Session, experiment_id: str) -> int:
    """Queries that have a label or may still get one: neither failed nor skipped by everybody that saw them."""
    skipped_away = (QueryRow.status == "open") & exists().where(
        LabelRow.query_id == QueryRow.id, LabelRow.state == "skip"
    )
    return (
        session.scalar(
            select(func.count())
            .select_from(QueryRow)
            .where(QueryRow.experiment_id == experiment_id, QueryRow.status != "failed", ~skipped_away)
        )
        or 0
    )


def count_rendering(session: Session, experiment_id: str) -> int:
    return (
        session.scalar(
            select(func.count())
            .select_from(QueryRow)
            .where(QueryRow.experiment_id == experiment_id, QueryRow.status == "rendering")
        )
        or 0
    )


def lock_rendering_with(session: Session, segment_id: str) -> list[QueryRow]:
    """Queries that wait for the clip of a segment."""
    return list(
        session.scalars(
            select(QueryRow)
            .join(SegmentRow, SegmentRow.experiment_id == QueryRow.experiment_id)
            .where(
                SegmentRow.id == segment_id,
                QueryRow.status == "rendering",
                or_(QueryRow.segment_0_id == segment_id, QueryRow.segment_1_id == segment_id),
            )
            .order_by(QueryRow.number)
            .with_for_update(of=QueryRow)
        )
    )


def _side_columns(segment: type[SegmentRow], clip: type[ClipRow]) -> tuple[Any, ...]:
    return (segment.id, segment.blob_key, segment.length_steps, segment.true_return, clip.id, clip.seconds, clip.frames)
