"""Rows of queries, their leases, and the sides on which they were shown.

The statements used for every label are built once at import and bound to values when run, because building a statement
takes ten times as long as running it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import bindparam, exists, func, insert, or_, select, update
from sqlalchemy.orm import Session, aliased

from accord.store.tables import ClipRow, ExperimentRow, LabelRow, PresentationRow, QueryRow, SegmentRow

_SEGMENT_0, _SEGMENT_1 = aliased(SegmentRow), aliased(SegmentRow)
_CLIP_0, _CLIP_1 = aliased(ClipRow), aliased(ClipRow)


@dataclass(frozen=True, slots=True)
class QuerySegment:
    """One segment of a query with the properties of its clip."""

    segment_id: str
    blob_key: str
    length_steps: int
    true_return: float
    #: None if the experiment renders no clips
    clip_id: str | None
    clip_seconds: float | None
    clip_frames: int | None


@dataclass(frozen=True, slots=True)
class ShownQuery:
    """A query with its two segments and the sides chosen for one user."""

    query_id: str
    experiment_id: str
    number: int
    #: None until it is first shown to this user
    left_segment: int | None
    segments: tuple[QuerySegment, QuerySegment]


@dataclass(frozen=True, slots=True)
class Response:
    """A teacher's label, skip or undo on a query."""

    #: P(segment 0 is preferred); None when skipped or undone
    value: float | None
    #: label | skip | undone
    state: str
    #: the segment shown on the left; None for a program
    left_segment: int | None
    response_seconds: float | None
    teacher: dict[str, Any]


#: the columns of a label that are the fields of its Response, in order
RESPONSE_COLUMNS: tuple[Any, ...] = (
    LabelRow.value,
    LabelRow.state,
    LabelRow.left_segment,
    LabelRow.response_seconds,
    LabelRow.teacher,
)


@dataclass(frozen=True, slots=True)
class LockedQuery:
    """A locked query with everything that decides whether a user may label it."""

    query_id: str
    experiment_id: str
    experiment_status: str
    status: str
    leased_by: str | None
    leased_until: datetime | None
    #: the tab of the user that holds it; empty if the client named none
    leased_tab: str
    #: the segment shown to the user on the left; None if the query was never shown to the user
    left_segment: int | None
    #: the user's own label and its content; None if there is none
    label_id: str | None
    label_revision: int
    response: Response | None


_LOCK = (
    select(
        QueryRow.id,
        QueryRow.experiment_id,
        ExperimentRow.status,
        QueryRow.status,
        QueryRow.leased_by,
        QueryRow.leased_until,
        QueryRow.leased_tab,
        PresentationRow.left_segment,
        LabelRow.id,
        LabelRow.revision,
        *RESPONSE_COLUMNS,
    )
    .join(ExperimentRow, ExperimentRow.id == QueryRow.experiment_id)
    .outerjoin(LabelRow, (LabelRow.query_id == QueryRow.id) & (LabelRow.user_id == bindparam("user")))
    .outerjoin(
        PresentationRow, (PresentationRow.query_id == QueryRow.id) & (PresentationRow.user_id == bindparam("user"))
    )
    .where(QueryRow.id == bindparam("query"))
    .with_for_update(of=QueryRow)
)
_LEASED = (
    select(QueryRow.id)
    .where(
        QueryRow.leased_by == bindparam("user"),
        QueryRow.experiment_id == bindparam("experiment"),
        # No condition on the status: only open queries are leased, and with one SQLite would scan all open queries
        # instead of this user's.
        QueryRow.leased_until > bindparam("now"),
        QueryRow.leased_tab == bindparam("tab"),
    )
    .order_by(QueryRow.number)
    .limit(bindparam("limit"))
    # so that a lease cannot pass to another user between this statement and the update
    .with_for_update()
)
_FREE = (
    select(QueryRow.id)
    .where(
        QueryRow.experiment_id == bindparam("experiment"),
        QueryRow.status == "open",
        or_(QueryRow.leased_by.is_(None), QueryRow.leased_until <= bindparam("now")),
        ~exists().where(
            LabelRow.query_id == QueryRow.id, LabelRow.user_id == bindparam("user"), LabelRow.state != "undone"
        ),
    )
    .order_by(QueryRow.number)
    .limit(bindparam("limit"))
    .with_for_update(skip_locked=True)
)
_SET = update(QueryRow).where(QueryRow.id == bindparam("query"))
_PRESENT = insert(PresentationRow)


def _side_columns(segment: type[SegmentRow], clip: type[ClipRow]) -> tuple[Any, ...]:
    return (segment.id, segment.blob_key, segment.length_steps, segment.true_return, clip.id, clip.seconds, clip.frames)


_SHOWN_COLUMNS: list[Any] = [
    QueryRow.id,
    QueryRow.experiment_id,
    QueryRow.number,
    PresentationRow.left_segment,
    *_side_columns(_SEGMENT_0, _CLIP_0),
    *_side_columns(_SEGMENT_1, _CLIP_1),
]
_SHOWN = (
    select(*_SHOWN_COLUMNS)
    .join(_SEGMENT_0, _SEGMENT_0.id == QueryRow.segment_0_id)
    .join(_SEGMENT_1, _SEGMENT_1.id == QueryRow.segment_1_id)
    .outerjoin(_CLIP_0, (_CLIP_0.segment_id == QueryRow.segment_0_id) & (_CLIP_0.status == "ready"))
    .outerjoin(_CLIP_1, (_CLIP_1.segment_id == QueryRow.segment_1_id) & (_CLIP_1.status == "ready"))
    .outerjoin(
        PresentationRow, (PresentationRow.query_id == QueryRow.id) & (PresentationRow.user_id == bindparam("user"))
    )
    .where(QueryRow.id.in_(bindparam("queries", expanding=True)))
    .order_by(QueryRow.number)
)


def lock(session: Session, query_id: str, user_id: str) -> LockedQuery | None:
    """Locks a query until the end of the transaction; returns it with one user's label and side."""
    found: Any = session.connection().execute(_LOCK, {"query": query_id, "user": user_id}).first()
    if found is None:
        return None
    return LockedQuery(
        query_id=found[0],
        experiment_id=found[1],
        experiment_status=found[2],
        status=found[3],
        leased_by=found[4],
        leased_until=found[5],
        leased_tab=found[6],
        left_segment=found[7],
        label_id=found[8],
        label_revision=found[9] or 0,
        response=None if found[8] is None else Response(*found[10:]),
    )


def leased_ids(session: Session, user_id: str, experiment_id: str, now: datetime, limit: int, *, tab: str) -> list[str]:
    """Queries on which a tab of a user holds an unexpired lease, by number."""
    values = {"user": user_id, "tab": tab, "experiment": experiment_id, "now": now, "limit": limit}
    return list(session.connection().scalars(_LEASED, values))


def lock_free_ids(session: Session, user_id: str, experiment_id: str, now: datetime, limit: int) -> list[str]:
    """Open queries without a lease that the user has not skipped, by number."""
    values = {"user": user_id, "experiment": experiment_id, "now": now, "limit": limit}
    return list(session.connection().scalars(_FREE, values))


def lease(session: Session, query_ids: Sequence[str], user_id: str, until: datetime, tab: str) -> None:
    """Leases open queries to a tab of a user."""
    session.connection().execute(
        _SET,
        [{"query": query_id, "leased_by": user_id, "leased_until": until, "leased_tab": tab} for query_id in query_ids],
    )


def set_lease(
    session: Session, query_id: str, status: str, leased_by: str | None, until: datetime | None, *, tab: str = ""
) -> None:
    """Sets the status and the lease of a locked query."""
    session.connection().execute(
        _SET,
        {"query": query_id, "status": status, "leased_by": leased_by, "leased_until": until, "leased_tab": tab},
    )


def with_sides(session: Session, query_ids: Sequence[str], user_id: str) -> list[ShownQuery]:
    """The queries with their segments and the sides that one user sees, by number."""
    rows: Iterable[Any] = session.connection().execute(_SHOWN, {"queries": query_ids, "user": user_id})
    return [
        ShownQuery(row[0], row[1], row[2], row[3], (QuerySegment(*row[4:11]), QuerySegment(*row[11:18])))
        for row in rows
    ]


def add_presentations(session: Session, user_id: str, left_segments: dict[str, int], now: datetime) -> None:
    """Stores which segment is on the left, by query id."""
    session.connection().execute(
        _PRESENT,
        [
            {"query_id": query_id, "user_id": user_id, "left_segment": left, "shown_at": now}
            for query_id, left in left_segments.items()
        ],
    )


def pairs(session: Session, experiment_id: str) -> set[frozenset[str]]:
    """Every pair of segments that has a query, in either order."""
    rows = session.execute(
        select(QueryRow.segment_0_id, QueryRow.segment_1_id).where(QueryRow.experiment_id == experiment_id)
    )
    return {frozenset((first, second)) for first, second in rows}


def last_number(session: Session, experiment_id: str) -> int:
    """The highest number of an experiment's queries; 0 if there is none."""
    return session.scalar(select(func.max(QueryRow.number)).where(QueryRow.experiment_id == experiment_id)) or 0


def count_labellable(session: Session, experiment_id: str) -> int:
    """Queries that are labelled or may still be: neither failed nor skipped."""
    return _count_not_skipped(session, experiment_id, ("rendering", "open", "closed"))


def count_unanswered(session: Session, experiment_id: str) -> int:
    """Queries that may still get a label: not failed, labelled or skipped."""
    return _count_not_skipped(session, experiment_id, ("rendering", "open"))


def _count_not_skipped(session: Session, experiment_id: str, statuses: Sequence[str]) -> int:
    skipped = (QueryRow.status == "open") & exists().where(LabelRow.query_id == QueryRow.id, LabelRow.state == "skip")
    statement = select(func.count()).where(
        QueryRow.experiment_id == experiment_id, QueryRow.status.in_(statuses), ~skipped
    )
    return session.scalar(statement) or 0


def count_rendering(session: Session, experiment_id: str) -> int:
    statement = select(func.count()).where(QueryRow.experiment_id == experiment_id, QueryRow.status == "rendering")
    return session.scalar(statement) or 0


def lock_rendering_with(session: Session, segment_id: str) -> list[QueryRow]:
    """Locks and returns the queries that wait for the clip of a segment."""
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
