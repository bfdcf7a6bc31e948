"""Refuses large bodies before they are in memory, whether or not their length is announced."""

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from accord.api.errors import accord_error_response
from accord.domain.errors import BodyTooLarge


class BodyLimit:
    """Plain ASGI middleware: answers 413 to a body longer than the limit and reads no more of it."""

    def __init__(self, app: ASGIApp, limit_bytes: int) -> None:
        self.app = app
        self._limit_bytes = limit_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        if _announced_bytes(scope) > self._limit_bytes:
            await self._refuse(scope, receive, send)
            return
        received = 0
        started = too_large = False

        async def counting_receive() -> Message:
            nonlocal received, too_large
            message = await receive()
            received += len(message.get("body", b""))
            if received > self._limit_bytes:
                too_large = True
                raise BodyTooLarge(self._limit_bytes)
            return message

        async def watched_send(message: Message) -> None:
            nonlocal started
            # The framework turns what `counting_receive` raised into an answer of its own; ours replaces it.
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
            await self._refuse(scope, receive, send)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send) -> None:
        response = accord_error_response(BodyTooLarge(self._limit_bytes))
        # the rest of the body is still on its way
        response.headers["Connection"] = "close"
        await response(scope, receive, send)


def _announced_bytes(scope: Scope) -> int:
    for name, value in scope["headers"]:
        if name == b"content-length":
            return int(value) if value.isdigit() else 0
    return 0
