"""Refuses request bodies that are too large, too slow, or sent by somebody who is not signed in.

The framework reads a body before it looks at the token. This middleware verifies the token first, unless the whole body
arrived with its headers, as most do, and costs nothing any more.
"""

import asyncio
import time
from collections.abc import Mapping

from anyio.to_thread import run_sync
from fastapi import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from accord.api.connections import BODY_ACCEPTED, LEAST_TRANSFER_BYTES
from accord.api.dependencies import authentication, verify
from accord.api.errors import accord_error_response
from accord.domain.errors import AccordError, BodyTooLarge, BodyTooSlow

#: largest body of a request without a token: the name of a new member
_PUBLIC_BODY_BYTES = 10_000


class BodyLimit:
    """ASGI middleware: responds 413, 408 or 401, and reads no more of the body."""

    def __init__(
        self,
        app: ASGIApp,
        *,
        limit_bytes: int,
        larger: Mapping[str, int],
        transfer_seconds: float,
        authenticated: str,
        public: tuple[str, ...],
    ) -> None:
        """
        Args:
            larger: limits of the paths that store their body in a file.
            transfer_seconds: in each such time, `LEAST_TRANSFER_BYTES` or the rest of the body must arrive.
            authenticated: beginning of the paths that need a token.
            public: beginnings of those among them that need none.
        """
        self.app = app
        self._limit_bytes = limit_bytes
        self._larger = larger
        self._transfer_seconds = transfer_seconds
        self._authenticated, self._public = authenticated, public

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or (length := _body_length(scope)) == 0:
            await self.app(scope, receive, send)
            return
        path: str = scope["path"]
        needs_token = path.startswith(self._authenticated) and not path.startswith(self._public)
        limit_bytes = self._larger.get(path, self._limit_bytes) if needs_token else _PUBLIC_BODY_BYTES
        body = _Body(receive, limit_bytes, self._transfer_seconds)
        try:
            if length is not None and length > limit_bytes:
                raise BodyTooLarge(limit_bytes)
            if needs_token:
                auth = await authentication(Request(scope))
                if not await body.arrived():
                    await run_sync(verify, auth)
                    scope.setdefault("state", {})[BODY_ACCEPTED] = True
        except AccordError as error:
            await _refuse(error, scope, receive, send)
            return
        started = False

        async def watched_send(message: Message) -> None:
            nonlocal started
            # Drops the response that the framework makes of the exception raised by `_Body.receive`.
            if body.refusal is not None and not started:
                return
            started = True
            await send(message)

        try:
            await self.app(scope, body.receive, watched_send)
        except (BodyTooLarge, BodyTooSlow):
            if started:
                raise
        if body.refusal is not None and not started:
            await _refuse(body.refusal, scope, receive, send)


class _Body:
    """Receives the body of one request within its limits."""

    def __init__(self, receive: Receive, limit_bytes: int, transfer_seconds: float) -> None:
        self._receive, self._limit_bytes, self._transfer_seconds = receive, limit_bytes, transfer_seconds
        self._first: Message | None = None
        self._complete = False
        self._received_bytes = 0
        #: received, and seconds left, of the `LEAST_TRANSFER_BYTES` that are due next
        self._due_bytes, self._due_seconds = 0, transfer_seconds
        #: why no more is received
        self.refusal: AccordError | None = None

    async def arrived(self) -> bool:
        """Wait for the first part of the body. Returns whether that is all of it, or the client has gone."""
        self._first = await self._receive()
        return self._first["type"] != "http.request" or not self._first.get("more_body", False)

    async def receive(self) -> Message:
        """The next message. Raises BodyTooLarge, BodyTooSlow."""
        if self._complete:
            return await self._receive()
        message, self._first = self._first or await self._next(), None
        size = len(message.get("body", b""))
        self._received_bytes += size
        self._due_bytes += size
        if self._received_bytes > self._limit_bytes:
            self.refusal = BodyTooLarge(self._limit_bytes)
            raise self.refusal
        if self._due_bytes >= LEAST_TRANSFER_BYTES:
            self._due_bytes, self._due_seconds = 0, self._transfer_seconds
        self._complete = not message.get("more_body", False)
        return message

    async def _next(self) -> Message:
        # Only the client's time counts, not that of storing what it sent.
        started = time.monotonic()
        try:
            async with asyncio.timeout(self._due_seconds):
                return await self._receive()
        except TimeoutError as error:
            self.refusal = BodyTooSlow()
            raise self.refusal from error
        finally:
            self._due_seconds -= time.monotonic() - started


async def _refuse(error: AccordError, scope: Scope, receive: Receive, send: Send) -> None:
    response = accord_error_response(error)
    # the client is still sending the rest of the body
    response.headers["Connection"] = "close"
    await response(scope, receive, send)


def _body_length(scope: Scope) -> int | None:
    """The announced length of the body; None if there is a body without one, 0 if there is none."""
    for name, value in scope["headers"]:
        if name == b"content-length":
            return int(value) if value.isdigit() else None
        if name == b"transfer-encoding":
            return None
    return 0
