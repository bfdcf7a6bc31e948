"""Queries and labels: the way a person, or a program, says which of two segments is better."""

from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.responses import Response

from accord.api import responses, schemas
from accord.api.dependencies import ExperimentId, QueryId, Signed, VisitDep, answer
from accord.domain.errors import AccordError
from accord.domain.ids import check_id
from accord.domain.permissions import may_label_in_batches, require, require_returns
from accord.services import experiments, label, lease

router = APIRouter(tags=["labelling"])


@router.post(
    "/experiments/{experiment_id}/queries/next", response_model=schemas.Queries, summary="Get the next queries"
)
def next_queries(
    experiment_id: ExperimentId,
    visit: VisitDep,
    count: Annotated[int, Query(ge=1, le=16, description="Queries to hold at once.")] = 1,
    returns: Annotated[bool, Query(description="Add true returns and rewards; not for labellers.")] = False,
) -> Response:
    """Leases queries to the caller: those already held come first, on the sides they were first shown with.

    Fewer than `count`, with a reason, when there are no more.
    """
    house = visit.house
    lease_seconds = house.settings.lease_seconds
    with visit.writing() as signed:
        if returns:
            require_returns(signed.role)
        found = lease.next_queries(signed.session, signed.user, experiment_id, count, lease_seconds)
        blobs = house.blobs if returns else None
        items = [responses.query_view(item, found.task, lease_seconds, blobs) for item in found.items]
        return answer(schemas.Queries(items=items, reason=found.reason))


@router.put("/queries/{query_id}/lease", summary="Keep a query")
def heartbeat(query_id: QueryId, visit: VisitDep) -> schemas.Lease:
    """Lengthens the lease, for someone who looks at the clips for long."""
    lease_seconds = visit.house.settings.lease_seconds
    with visit.writing() as signed:
        lease.heartbeat(signed.session, signed.user, query_id, lease_seconds)
        return schemas.Lease(query_id=query_id, lease_seconds=lease_seconds)


@router.delete("/queries/{query_id}/lease", status_code=204, summary="Give a query back")
def release(query_id: QueryId, visit: VisitDep) -> Response:
    """Ends the caller's lease, so that another may have the query at once."""
    with visit.writing() as signed:
        lease.release(signed.session, signed.user, query_id)
        return Response(status_code=204)


@router.put(
    "/queries/{query_id}/label",
    response_model=schemas.Label,
    responses={201: {"model": schemas.Label, "description": "Written, or changed."}},
    summary="Label or skip a query",
)
def put_label(query_id: QueryId, body: schemas.NewLabel, visit: VisitDep) -> Response:
    """Writes the caller's label, or changes it. 201 when something changed, 200 when the same was there already."""
    with visit.writing() as signed:
        outcome = _put(signed, query_id, body, None)
        return answer(responses.label_view(outcome), 201 if outcome.created else 200)


@router.delete("/queries/{query_id}/label", response_model=schemas.Query, summary="Undo a label")
def undo_label(query_id: QueryId, visit: VisitDep) -> Response:
    """Takes the caller's label or skip back, and leases the query to the caller again."""
    lease_seconds = visit.house.settings.lease_seconds
    with visit.writing() as signed:
        row = label.undo(signed.session, signed.user, query_id, lease_seconds)
        item = lease.offered(signed.session, signed.user, query_id)
        task = experiments.get(signed.session, row.experiment_id).config["task"]
        return answer(responses.query_view(item, task, lease_seconds))


@router.post(
    "/experiments/{experiment_id}/labels", response_model=schemas.LabelBatchResult, summary="Write many labels"
)
def put_labels(experiment_id: ExperimentId, body: schemas.LabelBatch, visit: VisitDep) -> Response:
    """For programs: each label is written or refused by itself, and the good ones are committed together.

    Teachers, researchers and admins may.
    """
    with visit.writing() as signed:
        require(may_label_in_batches(signed.role), signed.role, "label in batches")
        experiments.get(signed.session, experiment_id)
        items = [_outcome(signed, experiment_id, each) for each in body.labels]
        return answer(schemas.LabelBatchResult(items=items))


def _outcome(signed: Signed, experiment_id: str, each: schemas.BatchLabel) -> schemas.BatchOutcome:
    try:
        check_id(each.query_id, "qry")
        # A refusal comes before the first change, so there is nothing to roll back.
        outcome = _put(signed, each.query_id, each, experiment_id)
    except AccordError as error:
        return schemas.BatchOutcome(query_id=each.query_id, ok=False, code=error.code, message=str(error))
    return schemas.BatchOutcome(query_id=each.query_id, ok=True, label=responses.label_view(outcome))


def _put(signed: Signed, query_id: str, body: schemas.NewLabel, experiment_id: str | None) -> label.LabelOutcome:
    return label.put_label(
        signed.session,
        signed.user,
        query_id,
        body.label,
        body.order,
        response_seconds=body.response_seconds,
        teacher=body.teacher,
        experiment_id=experiment_id,
    )
