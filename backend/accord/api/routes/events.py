"""Live events: what changed in an experiment, pushed to the page as server-sent events.

The server looks at the rows twice a second, in a thread, and sends what is new. Rows are the truth; an event that
nobody received is found again by the next look.
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
from accord.domain.errors import Unauthenticated
from accord.services import experiments, metrics, workers

router = APIRouter(tags=["experiments"])
LOOK_SECONDS = 0.5
#: a client that takes nothing for so long is gone
_SEND_TIMEOUT_SECONDS = 30.0
#: a worker that was silent for so long shows as such: its event is sent again
_SILENT_SECONDS = 20.0
_WORKERS = TypeAdapter(list[schemas.Worker])


@dataclass(slots=True)
class Watch:
    """What one client has been sent."""

    auth: Auth
    experiment_id: str
    #: id of the newest metric point
    after_id: int
    sent: dict[str, str] = field(default_factory=dict[str, str])

    def look(self) -> list[ServerSentEvent]:
        """Events for what changed since the last look; blocks on the database.

        Raises:
            ExperimentNotFound: if there is no such experiment.
            Unauthenticated: if the token was made worthless meanwhile.
        """
        with self.auth.reading() as caller:
            row = experiments.get(caller.session, self.experiment_id)
            experiment = responses.experiment_response(caller.session, row, caller.role).model_dump_json()
            # all of them move the mark, so that hidden ones are not read again and again
            found = metrics.series(caller.session, self.experiment_id, None, self.after_id)
            self.after_id = max((point.id for curve in found for point in curve.points), default=self.after_id)
            curves = metrics.visible(found, row, caller.role)
            crew = [responses.worker_response(each, caller.role) for each in workers.all(caller.session)]
        events: list[ServerSentEvent] = []
        if self._is_news("experiment", experiment):
            events.append(self._event("experiment", experiment))
        if curves:
            events.append(self._event("metrics", responses.metrics_response(curves).model_dump_json()))
        if self._is_news("workers", _standing(crew)):
            events.append(self._event("workers", _WORKERS.dump_json(crew).decode()))
        return events

    def _is_news(self, name: str, state: str) -> bool:
        news = self.sent.get(name) != state
        self.sent[name] = state
        return news

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

    The first `metrics` event holds the whole curves, or those after `Last-Event-ID`. A point at a step that was sent
    before replaces it.
    """
    after_id = int(last_event_id) if last_event_id and last_event_id.isdecimal() and len(last_event_id) < 19 else 0
    watch = Watch(auth, experiment_id, after_id)
    # before the stream begins, while an error can still have its status
    first = await run_sync(watch.look)
    return EventSourceResponse(_stream(watch, first), send_timeout=_SEND_TIMEOUT_SECONDS)


async def _stream(watch: Watch, first: list[ServerSentEvent]) -> AsyncGenerator[ServerSentEvent]:
    events = first
    while True:
        for event in events:
            yield event
        await anyio.sleep(LOOK_SECONDS)
        try:
            events = await run_sync(watch.look)
        except Unauthenticated:
            return  # signed out: the browser's next attempt is told so


def _standing(crew: list[schemas.Worker]) -> str:
    """Workers without what changes all the time."""
    states: list[dict[str, Any]] = [
        each.model_dump(exclude={"heartbeat_age_seconds"}) | {"silent": each.heartbeat_age_seconds > _SILENT_SECONDS}
        for each in crew
    ]
    return json.dumps(states)
