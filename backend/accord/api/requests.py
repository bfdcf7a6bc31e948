"""Requests as they are logged: each has an id, which is on every line about it and in its response."""

import logging
import re
import time
from collections.abc import Callable

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from structlog.contextvars import bound_contextvars

from accord.domain.ids import new_id

log = logging.getLogger(__name__)

REQUEST_ID = "request_id"
_HEADER = "X-Request-ID"
#: ids of clients and proxies that are used instead of a new one; others could forge lines of the log
_CLIENT_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
#: slower requests are logged
_SLOW_SECONDS = 1.0
#: called with the method, route, status and seconds of a request
Observe = Callable[[str, str, int, float], None]


class Requests:
    """ASGI middleware: gives every request an id, and logs and reports it when its response begins.

    The time of a request ends there, so that neither slow clients nor event streams, which last for hours, count.
    """

    def __init__(self, app: ASGIApp, observe: Observe, *, log_all: bool) -> None:
        self.app = app
        self._observe = observe
        self._log_all = log_all

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        started = time.perf_counter()
        request_id = _request_id(Headers(scope=scope).get(_HEADER, ""))
        scope.setdefault("state", {})[REQUEST_ID] = request_id

        async def send_with_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[_HEADER] = request_id
                self._report(scope, message["status"], time.perf_counter() - started)
            await send(message)

        with bound_contextvars(request_id=request_id):
            await self.app(scope, receive, send_with_id)

    def _report(self, scope: Scope, status: int, seconds: float) -> None:
        method, route = scope["method"], route_of(scope)
        self._observe(method, route, status, seconds)
        if self._log_all or status >= 500 or seconds > _SLOW_SECONDS:
            fields = {"method": method, "route": route, "status": status, "seconds": round(seconds, 4)}
            log.log(logging.WARNING if status >= 500 else logging.INFO, "Request", extra=fields)


def route_of(scope: Scope) -> str:
    """The path of the route below /api/v1, or "page" for requests that have none.

    It has the names of its parameters, since their values can be sign-in tokens.
    """
    return getattr(scope.get("route"), "path", "page")


def _request_id(requested: str) -> str:
    return requested if _CLIENT_ID.fullmatch(requested) else new_id("req")
