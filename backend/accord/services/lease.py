"""Leases of queries: each query is reserved for one labeller at a time, who sees its segments on random sides.

A labeller with several tabs has separate leases in each, so that two tabs never show the same pair. `tab` names the
tab; clients that name none share the leases of the empty name.

Other leases share `now_and_end`.
"""

import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Literal

from sqlalchemy.orm import Session

from accord.domain.enums import ExperimentStatus, QueryStatus
from accord.domain.errors import ExperimentNotFound, LeaseLost, QueryClosed, QueryNotFound
from accord.services.accounts import Caller
from accord.store import experiments, queries
from accord.store.experiments import LabellingState
from accord.store.queries import QuerySegment, ShownQuery
from accord.store.tables import utc_now

Reason = Literal["", "rendering", "policy_training", "all_labelled", "experiment_over", "paused"]


@dataclass(frozen=True, slots=True)
class LeasedQuery:
    """A query leased to one user."""

    id: str
    experiment_id: str
    number: int
    #: the segment, 0 or 1, that this user sees on the left
    left_segment: int
    #: segments 0 and 1
    segments: tuple[QuerySegment, QuerySegment]


@dataclass(frozen=True, slots=True)
class Leased:
    """Queries leased to a user by one request."""

    #: name of the experiment's task
    task: str
    items: list[LeasedQuery]
    #: why there are fewer than requested; empty if there are not
    reason: Reason


def next_queries(
    session: Session, user: Caller, experiment_id: str, count: int, lease_seconds: float, *, tab: str = ""
) -> Leased:
    """Leases up to `count` queries to a user: first those this tab holds already, then free ones, by number.

    A query keeps the sides it was first shown with, so that reloading the page changes nothing.

    Raises:
        ExperimentNotFound: if there is no such experiment.
    """
    state = experiments.labelling_state(session, experiment_id)
    if state is None:
        raise ExperimentNotFound(experiment_id)
    task = str(state.config["task"])
    closed = _closed_reason(state)
    if closed:
        return Leased(task, [], closed)
    now, until = now_and_end(lease_seconds)
    ids = queries.leased_ids(session, user.id, experiment_id, now, count, tab=tab)
    if len(ids) < count:
        ids += queries.lock_free_ids(session, user.id, experiment_id, now, count - len(ids))
    if not ids:
        return Leased(task, [], _waiting_reason(session, experiment_id))
    queries.lease(session, ids, user.id, until, tab)
    items = _with_sides(session, user.id, ids)
    return Leased(task, items, "" if len(items) == count else _waiting_reason(session, experiment_id))


def leased_query(session: Session, user: Caller, query_id: str) -> LeasedQuery:
    """A leased query with the sides its user sees."""
    return _with_sides(session, user.id, [query_id])[0]


def shown_queries(session: Session, user: Caller, query_ids: Sequence[str]) -> list[LeasedQuery]:
    """Queries with the sides on which the user saw them, by number; segment 0 is left where the user saw none.

    A read-only session is enough.
    """
    return [_placed(row, row.left_segment or 0) for row in queries.with_sides(session, query_ids, user.id)]


def heartbeat(session: Session, user: Caller, query_id: str, lease_seconds: float, tab: str = "") -> None:
    """Renews a lease.

    Raises:
        QueryNotFound: if there is no such query.
        QueryClosed: if it is labelled already.
        LeaseLost: if another user or tab holds it, or this tab never did.
    """
    _, until = now_and_end(lease_seconds)
    found = queries.lock(session, query_id, user.id)
    if found is None:
        raise QueryNotFound(query_id)
    if found.status == QueryStatus.CLOSED:
        raise QueryClosed(query_id)
    # An expired lease that no other user has taken is still valid: a laptop that slept must not lose its pair.
    if (found.leased_by, found.leased_tab) != (user.id, tab):
        raise LeaseLost(query_id)
    queries.set_lease(session, query_id, found.status, user.id, until, tab=tab)


def release(session: Session, user: Caller, query_id: str, tab: str = "") -> None:
    """Ends a lease; does nothing if this tab holds none.

    Raises:
        QueryNotFound: if there is no such query.
    """
    found = queries.lock(session, query_id, user.id)
    if found is None:
        raise QueryNotFound(query_id)
    if (found.leased_by, found.leased_tab) == (user.id, tab):
        queries.set_lease(session, query_id, found.status, None, None)


def _with_sides(session: Session, user_id: str, ids: Sequence[str]) -> list[LeasedQuery]:
    rows = queries.with_sides(session, ids, user_id)
    # The system's random source, not a seeded one, so that nobody can predict a side.
    drawn = {row.query_id: secrets.randbelow(2) for row in rows if row.left_segment is None}
    if drawn:
        queries.add_presentations(session, user_id, drawn, utc_now())
    return [_placed(row, drawn[row.query_id] if row.left_segment is None else row.left_segment) for row in rows]


def _placed(row: ShownQuery, left_segment: int) -> LeasedQuery:
    return LeasedQuery(
        id=row.query_id,
        experiment_id=row.experiment_id,
        number=row.number,
        left_segment=left_segment,
        segments=row.segments,
    )


def _closed_reason(state: LabellingState) -> Reason:
    if state.status == ExperimentStatus.PAUSED:
        return "paused"
    if state.status != ExperimentStatus.RUNNING:
        return "experiment_over"
    config = state.config
    if config["reward_source"] == "true" or state.label_count >= config["label_budget"]:
        return "all_labelled"
    return ""


def _waiting_reason(session: Session, experiment_id: str) -> Reason:
    return "rendering" if queries.count_rendering(session, experiment_id) else "policy_training"


def now_and_end(lease_seconds: float) -> tuple[datetime, datetime]:
    """The current time, and the time at which a lease that begins now expires."""
    now = utc_now()
    return now, now + timedelta(seconds=lease_seconds)
