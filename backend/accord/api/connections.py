"""Limits of connections: how many there are, and how long a client may take to send a request or to read a response.

uvicorn closes connections that idle after a response, but waits without end for the rest of a request. Its
`limit_concurrency` counts connections that idle: a client that opens many would make every other request fail.
"""

import asyncio
import resource
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from accord.settings import Settings

#: key of a request's state that `BodyLimit` sets when the sender of the body is known
BODY_ACCEPTED = "body_accepted"
#: a client must read or send this much in each ACCORD_TRANSFER_TIMEOUT_SECONDS; 500 bytes a second by default
LEAST_TRANSFER_BYTES = 16_384
#: descriptors for the database, blobs, and connections that are accepted before others are closed
_RESERVED_DESCRIPTORS = 300
_TOO_MANY = b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nRetry-After: 5\r\nContent-Length: 0\r\n\r\n"


class Connections:
    """The open connections of a server and their limits."""

    def __init__(self, settings: Settings) -> None:
        descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        self._limit = settings.max_connections
        if descriptors != resource.RLIM_INFINITY:
            self._limit = max(1, min(self._limit, descriptors - _RESERVED_DESCRIPTORS))
        self.request_seconds = settings.request_timeout_seconds
        self.transfer_seconds = settings.transfer_timeout_seconds
        self._open: set[LimitedHttp] = set()
        # Dictionaries as ordered sets: those that have waited longest come first.
        self._without_request: dict[LimitedHttp, None] = {}
        self._idle: dict[LimitedHttp, None] = {}

    def add(self, connection: "LimitedHttp") -> bool:
        """Count a new connection. Returns False if there are too many and none can be closed in its place.

        Those that wait for a request can be closed: first those that never sent a whole one, as an attacker's do.
        """
        while len(self._open) >= self._limit:
            waiting = next(iter(self._without_request or self._idle), None)
            if waiting is None:
                return False
            self.remove(waiting)
            waiting.close()
        self._open.add(connection)
        return True

    def remove(self, connection: "LimitedHttp") -> None:
        self._open.discard(connection)
        self.mark_busy(connection)

    def mark_waiting(self, connection: "LimitedHttp", *, is_new: bool) -> None:
        """A connection waits for a request: its first one, or a further one."""
        (self._without_request if is_new else self._idle)[connection] = None

    def mark_busy(self, connection: "LimitedHttp") -> None:
        """A connection has a request."""
        self._without_request.pop(connection, None)
        self._idle.pop(connection, None)


class LimitedHttp(H11Protocol):
    """A connection of a client. A request counts as received when its body is, or the body's sender is known."""

    def __init__(self, *args: Any, connections: Connections, **options: Any) -> None:
        super().__init__(*args, **options)
        self._limits = connections
        self._request_timer: asyncio.TimerHandle | None = None
        self._write_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if not self._limits.add(self):
            transport.write(_TOO_MANY)
            transport.close()
            return
        self._watch_request()

    def connection_lost(self, exc: Exception | None) -> None:
        self._limits.remove(self)
        for timer in (self._request_timer, self._write_timer):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if not self.transport.is_closing():
            super().data_received(data)
            self._watch_request()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._watch_request()

    def close(self) -> None:
        """Close the connection, which waits for a request."""
        if not self.transport.is_closing():
            if self.conn.our_state in {h11.IDLE, h11.DONE}:
                self.conn.send(h11.ConnectionClosed())
            self.transport.close()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._watch_reader(self.transport.get_write_buffer_size())

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._write_timer is not None:
            self._write_timer.cancel()
            self._write_timer = None

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """There are no WebSockets."""
        self.send_400_response("Accord has no WebSockets.")

    def _should_upgrade_to_ws(self) -> bool:
        return True

    @property
    def _waits_for_request(self) -> bool:
        cycle = self.cycle
        # uvicorn declares it without None, which it is before the first request.
        if cycle is None or cycle.response_complete:  # pyright: ignore[reportUnnecessaryComparison]
            return True
        return cycle.more_body and not self.scope.get("state", {}).get(BODY_ACCEPTED)

    def _watch_request(self) -> None:
        if self.transport.is_closing():
            return
        if not self._waits_for_request:
            if self._request_timer is not None:
                self._request_timer.cancel()
                self._request_timer = None
                self._limits.mark_busy(self)
        elif self._request_timer is None:
            seconds = self._limits.request_seconds
            self._request_timer = self.loop.call_later(seconds, self._request_timed_out)
            self._limits.mark_waiting(self, is_new=self.cycle is None)  # pyright: ignore[reportUnnecessaryComparison]

    def _request_timed_out(self) -> None:
        self._request_timer = None
        self._limits.mark_busy(self)
        if self._waits_for_request:
            self.close()

    def _watch_reader(self, unread_bytes: int) -> None:
        def check() -> None:
            unread = self.transport.get_write_buffer_size()
            if unread_bytes - unread < LEAST_TRANSFER_BYTES:
                self.transport.abort()
            else:
                self._watch_reader(unread)

        self._write_timer = self.loop.call_later(self._limits.transfer_seconds, check)
