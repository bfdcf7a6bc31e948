"""Queries and labels: the way a person, or a program, says which of two segments is better."""

from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.responses import Response

from accord.api import responses, schemas
from accord.api.dependencies import AuthDep, CallerSession, ExperimentId, QueryId, json_response
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
    auth: AuthDep,
    count: Annotated[int, Query(ge=1, le=16, description="Queries to hold at once.")] = 1,
    returns: Annotated[bool, Query(description="Add true returns and rewards; not for labellers.")] = False,
) -> Response:
    """Leases queries to the caller: those already held come first, on the sides they were first shown with.

    Fewer than `count`, with a reason, when there are no more.
    """
    app = auth.app
    lease_seconds = app.settings.lease_seconds
    with auth.writing() as caller:
        if returns:
            require_returns(caller.role)
        found = lease.next_queries(caller.session, caller.user, experiment_id, count, lease_seconds)
        blobs = app.blobs if returns else None
        items = [responses.query_response(item, found.task, lease_seconds, blobs) for item in found.items]
        return json_response(schemas.Queries(items=items, reason=found.reason))


@router.put("/queries/{query_id}/lease", summary="Keep a query")
def heartbeat(query_id: QueryId, auth: AuthDep) -> schemas.Lease:
    """Lengthens the lease, for someone who looks at the clips for long."""
    lease_seconds = auth.app.settings.lease_seconds
    with auth.writing() as caller:
        lease.heartbeat(caller.session, caller.user, query_id, lease_seconds)
        return schemas.Lease(query_id=query_id, lease_seconds=lease_seconds)


@router.delete("/queries/{query_id}/lease", status_code=204, summary="Give a query back")
def release(query_id: QueryId, auth: AuthDep) -> Response:
    """Ends the caller's lease, so that another may have the query at once."""
    with auth.writing() as caller:
        lease.release(caller.session, caller.user, query_id)
        return Response(status_code=204)


@router.put(
    "/queries/{query_id}/label",
    response_model=schemas.Label,
    responses={201: {"model": schemas.Label, "description": "Written, or changed."}},
    summary="Label or skip a query",
)
def put_label(query_id: QueryId, body: schemas.NewLabel, auth: AuthDep) -> Response:
    """Writes the caller's label, or changes it. 201 when something changed, 200 when the same was there already."""
    with auth.writing() as caller:
        outcome = _put(caller, query_id, body, None)
        return json_response(responses.label_response(outcome), 201 if outcome.created else 200)


@router.delete("/queries/{query_id}/label", response_model=schemas.Query, summary="Undo a label")
def undo_label(query_id: QueryId, auth: AuthDep) -> Response:
    """Takes the caller's label or skip back, and leases the query to the caller again."""
    lease_seconds = auth.app.settings.lease_seconds
    with auth.writing() as caller:
        row = label.undo(caller.session, caller.user, query_id, lease_seconds)
        item = lease.leased_query(caller.session, caller.user, query_id)
        task = experiments.get(caller.session, row.experiment_id).config["task"]
        return json_response(responses.query_response(item, task, lease_seconds))


@router.post(
    "/experiments/{experiment_id}/labels", response_model=schemas.LabelBatchResult, summary="Write many labels"
)
def put_labels(experiment_id: ExperimentId, body: schemas.LabelBatch, auth: AuthDep) -> Response:
    """For programs: each label is written or refused by itself, and the good ones are committed together.

    Teachers, researchers and admins may.
    """
    with auth.writing() as caller:
        require(may_label_in_batches(caller.role), caller.role, "label in batches")
        experiments.get(caller.session, experiment_id)
        items = [_outcome(caller, experiment_id, each) for each in body.labels]
        return json_response(schemas.LabelBatchResult(items=items))


def _outcome(caller: CallerSession, experiment_id: str, each: schemas.BatchLabel) -> schemas.BatchOutcome:
    try:
        check_id(each.query_id, "qry")
        # A refusal comes before the first change, so there is nothing to roll back.
        outcome = _put(caller, each.query_id, each, experiment_id)
    except AccordError as error:
        return schemas.BatchOutcome(query_id=each.query_id, ok=False, code=error.code, message=str(error))
    return schemas.BatchOutcome(query_id=each.query_id, ok=True, label=responses.label_response(outcome))


def _put(caller: CallerSession, query_id: str, body: schemas.NewLabel, experiment_id: str | None) -> label.LabelOutcome:
    return label.put_label(
        caller.session,
        caller.user,
        query_id,
        body.label,
        body.order,
        response_seconds=body.response_seconds,
        teacher=body.teacher,
        experiment_id=experiment_id,
    )
