"""Live events: changes of an experiment, pushed to the page as server-sent events.

A thread polls the rows twice a second and sends what changed. The rows hold the state; a client that missed an event
receives the change with its next connection.
"""

import json
from collections.abc import AsyncGenerator
from dataclasses import dataclass, field
from typing import Annotated, Any

import anyio
from anyio.to_thread import run_sync
from fastapi import APIRouter, Header
from pydantic import TypeAdapter
from sse_starlette import EventSourceResponse, ServerSentEvent

from accord.api import responses, schemas
from accord.api.dependencies import Auth, AuthDep, ExperimentId
from accord.domain.errors import ExperimentNotFound, Unauthenticated
from accord.services import experiments, metrics, workers

router = APIRouter(tags=["experiments"])
POLL_SECONDS = 0.5
#: a client that accepts no data for this long is disconnected
_SEND_TIMEOUT_SECONDS = 30.0
#: a worker without a heartbeat for this long counts as silent; the same limit as on the page (status.ts)
_SILENT_SECONDS = 30.0
_WORKERS = TypeAdapter(list[schemas.Worker])


@dataclass(slots=True)
class Watch:
    """The events of one client, and what it has already received."""

    auth: Auth
    experiment_id: str
    #: id of the newest metric point
    after_id: int
    sent: dict[str, str] = field(default_factory=dict[str, str])

    def poll(self) -> list[ServerSentEvent]:
        """Events for what changed since the last poll; blocks on the database.

        Raises:
            ExperimentNotFound: if there is no such experiment.
            Unauthenticated: if the token is no longer valid.
        """
        with self.auth.reading() as caller:
            row = experiments.get(caller.session, self.experiment_id)
            experiment = responses.experiment_response(caller.session, row, caller.role).model_dump_json()
            # hidden curves advance the id too, so that they are not read again
            found = metrics.series(caller.session, self.experiment_id, None, self.after_id)
            self.after_id = max((point.id for curve in found for point in curve.points), default=self.after_id)
            curves = metrics.visible(found, row, caller.role)
            reported = [responses.worker_response(each, caller.role) for each in workers.all(caller.session)]
        events: list[ServerSentEvent] = []
        if self._changed("experiment", experiment):
            events.append(self._event("experiment", experiment))
        if curves:
            events.append(self._event("metrics", responses.metrics_response(curves).model_dump_json()))
        if self._changed("workers", _without_ages(reported)):
            events.append(self._event("workers", _WORKERS.dump_json(reported).decode()))
        return events

    def _changed(self, name: str, state: str) -> bool:
        changed = self.sent.get(name) != state
        self.sent[name] = state
        return changed

    def _event(self, name: str, text: str) -> ServerSentEvent:
        return ServerSentEvent(text, event=name, id=str(self.after_id))


@router.get(
    "/experiments/{experiment_id}/events",
    response_class=EventSourceResponse,
    responses={
        200: {
            "content": {"text/event-stream": {}},
            "description": "`experiment`: Experiment. `metrics`: Metrics, new points. `workers`: list of Worker.",
        }
    },
    summary="Follow an experiment live",
)
async def follow_experiment(
    experiment_id: ExperimentId,
    auth: AuthDep,
    last_event_id: Annotated[str | None, Header(description="Resume after this event.")] = None,
) -> EventSourceResponse:
    """Server-sent events: `experiment` on any change, `metrics` with new points, `workers` when one changes.

    The first `metrics` event has all points, or those after `Last-Event-ID`. A point replaces one sent earlier for the
    same step.
    """
    after_id = int(last_event_id) if last_event_id and last_event_id.isdecimal() and len(last_event_id) < 19 else 0
    watch = Watch(auth, experiment_id, after_id)
    # before the stream begins, so that an error still has its status
    first = await run_sync(watch.poll)
    return EventSourceResponse(_stream(watch, first), send_timeout=_SEND_TIMEOUT_SECONDS)


async def _stream(watch: Watch, first: list[ServerSentEvent]) -> AsyncGenerator[ServerSentEvent]:
    events = first
    while True:
        for event in events:
            yield event
        await anyio.sleep(POLL_SECONDS)
        try:
            events = await run_sync(watch.poll)
        except (Unauthenticated, ExperimentNotFound):
            return  # signed out, or deleted; the browser's next request gets a 401 or a 404


def _without_ages(reported: list[schemas.Worker]) -> str:
    """The workers without the age of their heartbeats, which always changes."""
    states: list[dict[str, Any]] = [
        each.model_dump(exclude={"heartbeat_age_seconds"}) | {"silent": each.heartbeat_age_seconds > _SILENT_SECONDS}
        for each in reported
    ]
    return json.dumps(states)
