"""Labels: written once, changed by their author alone, undone, and never forgotten.

Every change is one more revision of the experiment. The revision, the label, its history and the experiment's count of
labels change in one transaction, so that the reward worker's watermark misses none.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

from sqlalchemy.orm import Session

from accord.domain.enums import LABEL_VALUES, QueryStatus, Role
from accord.domain.errors import (
    InvalidLabel,
    LabelConflict,
    LabelNotFound,
    LeaseLost,
    QueryClosed,
    QueryNotFound,
)
from accord.domain.ids import new_id
from accord.domain.permissions import may_label_in_batches
from accord.services.accounts import Caller
from accord.services.experiments import require_not_over
from accord.services.lease import now_and_end
from accord.services.validation import check_teacher
from accord.store import labels, queries
from accord.store.labels import StoredLabel
from accord.store.queries import LockedQuery, Response

Order = Literal["segments", "shown"]
_GIVEN = frozenset({"label", "skip"})


@dataclass(frozen=True, slots=True)
class LabelOutcome:
    """What became of a label that was sent."""

    row: StoredLabel
    #: False when the very same label was there already
    created: bool


def put_label(
    session: Session,
    user: Caller,
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
    described = check_teacher(teacher) if teacher else {}
    found = _locked(session, user, query_id, experiment_id)
    if order == "shown":
        if found.left_segment is None:
            raise LeaseLost(query_id)
        value = 1.0 - value if value is not None and found.left_segment == 1 else value
    response = Response(value, "skip" if value is None else "label", found.left_segment, response_seconds, described)
    previous, label_id = found.response, found.label_id
    if (
        previous is not None
        and label_id is not None
        and (previous.state, previous.value) == (response.state, response.value)
    ):
        return LabelOutcome(_stored(found, user, label_id, found.label_revision, previous), created=False)
    _require_labellable(user, found)
    row = _write(session, user, found, response)
    status = QueryStatus.CLOSED if response.state == "label" else QueryStatus.OPEN
    queries.set_lease(session, query_id, status.value, None, None)
    return LabelOutcome(row, created=True)


def undo(session: Session, user: Caller, query_id: str, lease_seconds: float = 60.0) -> StoredLabel:
    """Takes a user's label or skip back: the query is open again, and leased to the user.

    Raises:
        QueryNotFound: if there is no such query.
        LabelNotFound: if the user has no label on it.
        ExperimentNotActive: if the experiment is over.
        QueryClosed, LeaseLost: if, after a skip, another has labelled it or holds it.
    """
    found = _locked(session, user, query_id, None)
    if found.response is None or found.response.state not in _GIVEN:
        raise LabelNotFound(query_id)
    _require_labellable(user, found)
    row = _write(session, user, found, replace(found.response, value=None, state="undone"))
    _, until = now_and_end(lease_seconds)
    queries.set_lease(session, query_id, QueryStatus.OPEN.value, user.id, until)
    return row


def _locked(session: Session, user: Caller, query_id: str, experiment_id: str | None) -> LockedQuery:
    found = queries.lock(session, query_id, user.id)
    if found is None or (experiment_id is not None and found.experiment_id != experiment_id):
        raise QueryNotFound(query_id)
    return found


def _require_labellable(user: Caller, found: LockedQuery) -> None:
    """Raises unless this user may say something new about this query now."""
    require_not_over(found.experiment_id, found.experiment_status)
    previous_state = None if found.response is None else found.response.state
    if previous_state == "label":
        return  # the query is closed by this very label; its author may think again
    if found.status == QueryStatus.CLOSED:
        raise QueryClosed(found.query_id)
    if found.status != QueryStatus.OPEN:
        raise LabelConflict(
            f"Query {found.query_id!r} has no clips to look at ({found.status}). Ask for the next query."
        )
    if found.leased_by == user.id:
        # Also when the lease is over: nobody has taken it since, so nobody is asked twice.
        return
    now, _ = now_and_end(0.0)
    if found.leased_until is not None and found.leased_until > now:
        raise LeaseLost(found.query_id)
    if previous_state != "skip" and not may_label_in_batches(Role(user.role)):
        raise LeaseLost(found.query_id)


def _write(session: Session, user: Caller, found: LockedQuery, response: Response) -> StoredLabel:
    """The label, its history and the counters, all at once."""
    before = found.response is not None and found.response.state == "label"
    revision = labels.advance_revision(session, found.experiment_id, (response.state == "label") - before)
    label = _stored(found, user, found.label_id or new_id("lbl"), revision, response)
    now, _ = now_and_end(0.0)
    labels.write(session, label, response, now, new=found.label_id is None)
    return label


def _stored(found: LockedQuery, user: Caller, label_id: str, revision: int, response: Response) -> StoredLabel:
    return StoredLabel(
        id=label_id,
        experiment_id=found.experiment_id,
        query_id=found.query_id,
        user_id=user.id,
        value=response.value,
        state=response.state,
        revision=revision,
        left_segment=response.left_segment,
    )
