"""Labels: written once, changed by their author alone, undone, and never forgotten.

Every change is one more revision of the experiment. The revision, the label, its history and the experiment's count of
labels change in one transaction, so that the reward worker's watermark misses none.
"""

from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy.orm import Session

from accord.domain.errors import (
    InvalidLabel,
    LabelConflict,
    LabelNotFound,
    LeaseLost,
    QueryClosed,
    QueryNotFound,
)
from accord.domain.ids import new_id
from accord.domain.policy import may_label_in_batches
from accord.domain.words import LABEL_VALUES, QueryStatus, Role
from accord.services import experiments
from accord.services.clock import now_and_end
from accord.services.texts import check_teacher
from accord.store import queries
from accord.store.experiments import advance_revision
from accord.store.queries import QueryInHand
from accord.store.tables import LabelRevisionRow, LabelRow, QueryRow, UserRow

Order = Literal["segments", "shown"]
_SAID = frozenset({"label", "skip"})


@dataclass(frozen=True, slots=True)
class _Word:
    """What a teacher says of a query."""

    value: float | None
    #: label | skip | undone
    state: str
    left_segment: int | None
    response_seconds: float | None
    teacher: dict[str, Any]


@dataclass(frozen=True, slots=True)
class LabelOutcome:
    """What became of a label that was sent."""

    row: LabelRow
    #: False when the very same label was there already
    created: bool


def put_label(
    session: Session,
    user: UserRow,
    query_id: str,
    value: float | None,
    order: Order = "segments",
    *,
    response_seconds: float | None = None,
    teacher: dict[str, Any] | None = None,
    experiment_id: str | None = None,
) -> LabelOutcome:
    """Writes a user's label on a query, or changes it; the same label again changes nothing.

    A label closes the query. A skip leaves it open for others, and the user is not asked again.

    Args:
        value: 1, 0 or 0.5; None skips.
        order: `segments`: 1 prefers segment 0. `shown`: 1 prefers the left clip; the side that was drawn is undone.
        experiment_id: when given, the query must be of this experiment.

    Raises:
        InvalidLabel: for any other value. Invalid: if `teacher` is long or no JSON.
        QueryNotFound: if there is no such query (in this experiment).
        ExperimentNotActive: if the experiment is over.
        QueryClosed: if another has labelled it. LabelConflict: if it cannot be labelled yet, or never will.
        LeaseLost: if another holds it, or a labeller never did, or `shown` was never shown.
    """
    if value is not None and value not in LABEL_VALUES:
        raise InvalidLabel(value)
    described = check_teacher(teacher or {})
    found = _locked(session, user, query_id, experiment_id)
    if order == "shown":
        if found.left_segment is None:
            raise LeaseLost(query_id)
        value = 1.0 - value if value is not None and found.left_segment == 1 else value
    state = "skip" if value is None else "label"
    label = found.label
    if label is not None and (label.state, label.value) == (state, value):
        return LabelOutcome(label, created=False)
    query = found.query
    _require_labellable(session, user, found)
    word = _Word(value, state, found.left_segment, response_seconds, described)
    row = _write(session, user, query, label, word)
    query.status = QueryStatus.CLOSED.value if state == "label" else QueryStatus.OPEN.value
    query.leased_by = query.leased_until = None
    return LabelOutcome(row, created=True)


def undo(session: Session, user: UserRow, query_id: str, lease_seconds: float = 60.0) -> LabelRow:
    """Takes a user's label or skip back: the query is open again, and leased to the user.

    Raises:
        QueryNotFound: if there is no such query.
        LabelNotFound: if the user has no label on it.
        ExperimentNotActive: if the experiment is over.
        QueryClosed, LeaseLost: if, after a skip, another has labelled it or holds it.
    """
    found = _locked(session, user, query_id, None)
    query, label = found.query, found.label
    if label is None or label.state not in _SAID:
        raise LabelNotFound(query_id)
    _require_labellable(session, user, found)
    word = _Word(None, "undone", label.left_segment, label.response_seconds, label.teacher)
    _write(session, user, query, label, word)
    query.status = QueryStatus.OPEN.value
    _, query.leased_until = now_and_end(lease_seconds)
    query.leased_by = user.id
    return label


def _locked(session: Session, user: UserRow, query_id: str, experiment_id: str | None) -> QueryInHand:
    found = queries.lock(session, query_id, user.id)
    if found is None or (experiment_id is not None and found.query.experiment_id != experiment_id):
        raise QueryNotFound(query_id)
    return found


def _require_labellable(session: Session, user: UserRow, found: QueryInHand) -> None:
    """Raises unless this user may say something new about this query now."""
    query, label = found.query, found.label
    experiments.require_not_over(experiments.get(session, query.experiment_id))
    if label is not None and label.state == "label":
        return  # the query is closed by this very label; its author may think again
    if query.status == QueryStatus.CLOSED:
        raise QueryClosed(query.id)
    if query.status != QueryStatus.OPEN:
        raise LabelConflict(f"Query {query.id!r} has no clips to look at ({query.status}). Ask for the next query.")
    if query.leased_by == user.id:
        # Also when the lease is over: nobody has taken it since, so nobody is asked twice.
        return
    now, _ = now_and_end(0.0)
    if query.leased_until is not None and query.leased_until > now:
        raise LeaseLost(query.id)
    skipped_before = label is not None and label.state == "skip"
    if not skipped_before and not may_label_in_batches(Role(user.role)):
        raise LeaseLost(query.id)


def _write(session: Session, user: UserRow, query: QueryRow, label: LabelRow | None, word: _Word) -> LabelRow:
    """The label, its history and the counters, all at once."""
    before = label is not None and label.state == "label"
    revision = advance_revision(session, query.experiment_id, (word.state == "label") - before)
    now, _ = now_and_end(0.0)
    if label is None:
        label = LabelRow(
            id=new_id("lbl"),
            experiment_id=query.experiment_id,
            query_id=query.id,
            user_id=user.id,
            value=word.value,
            state=word.state,
            revision=revision,
            left_segment=word.left_segment,
            response_seconds=word.response_seconds,
            teacher=word.teacher,
            created_at=now,
            updated_at=now,
        )
        session.add(label)
        session.flush()
    else:
        label.value, label.state, label.revision = word.value, word.state, revision
        label.left_segment, label.response_seconds = word.left_segment, word.response_seconds
        label.teacher, label.updated_at = word.teacher, now
    session.add(
        LabelRevisionRow(
            experiment_id=query.experiment_id,
            revision=revision,
            label_id=label.id,
            value=word.value,
            state=word.state,
            left_segment=word.left_segment,
            response_seconds=word.response_seconds,
            created_at=now,
        )
    )
    session.flush()
    return label
