"""Rejects large request bodies before they are in memory, with or without a Content-Length."""

from collections.abc import Mapping

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from accord.api.errors import accord_error_response
from accord.domain.errors import BodyTooLarge


class BodyLimit:
    """ASGI middleware: responds 413 to a body above the limit, and reads no more of it."""

    def __init__(self, app: ASGIApp, limit_bytes: int, larger: Mapping[str, int]) -> None:
        """
        Args:
            larger: limits of the paths that store their body in a file.
        """
        self.app = app
        self._limit_bytes = limit_bytes
        self._larger = larger

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit_bytes = self._larger.get(scope["path"], self._limit_bytes)
        if _content_length(scope) > limit_bytes:
            await _refuse(limit_bytes, scope, receive, send)
            return
        received = 0
        started = too_large = False

        async def counting_receive() -> Message:
            nonlocal received, too_large
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit_bytes:
                too_large = True
                raise BodyTooLarge(limit_bytes)
            return message

        async def watched_send(message: Message) -> None:
            nonlocal started
            # Drops the response that the framework makes of the exception raised by `counting_receive`.
            if too_large and not started:
                return
            started = True
            await send(message)

        try:
            await self.app(scope, counting_receive, watched_send)
        except BodyTooLarge:
            if started:
                raise
        if too_large and not started:
            await _refuse(limit_bytes, scope, receive, send)


async def _refuse(limit_bytes: int, scope: Scope, receive: Receive, send: Send) -> None:
    response = accord_error_response(BodyTooLarge(limit_bytes))
    # the client is still sending the rest of the body
    response.headers["Connection"] = "close"
    await response(scope, receive, send)


def _content_length(scope: Scope) -> int:
    for name, value in scope["headers"]:
        if name == b"content-length":
            return int(value) if value.isdigit() else 0
    return 0
