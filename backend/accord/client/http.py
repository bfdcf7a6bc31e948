"""Requests to the REST API with a bearer token and retries, over a blocking or an asynchronous connection.

The retries are written once, as a coroutine. `BlockingConnection` has coroutines too, but they never wait for an event
loop, so that `finish` runs whatever is built on them to its end in one step.
"""

import asyncio
import json
import random
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol, TypedDict, TypeVar

import httpx

from accord.domain.errors import AccordError, Unavailable

_OWN_HOSTS = frozenset({"127.0.0.1", "localhost", "::1"})
_BUSY = frozenset({429, 502, 503, 504})
#: A restarting service responds again within this time.
RETRY_SECONDS = 60.0
_FIRST_PAUSE_SECONDS, _LONGEST_PAUSE_SECONDS = 0.2, 5.0
_TIMEOUT_SECONDS = 30.0
_PART_BYTES = 1 << 20
T = TypeVar("T")


class Refused(AccordError):
    """The service refused a request."""

    def __init__(self, status: int, code: str, message: str) -> None:
        super().__init__(message)
        self.status = status
        #: the `code` of the API's error
        self.reason = code


class ConnectionOptions(TypedDict):
    """Arguments of httpx.Client and httpx.AsyncClient."""

    base_url: str
    headers: dict[str, str]
    timeout: float
    trust_env: bool


class Connection(Protocol):
    """Sends one request."""

    async def send(self, method: str, path: str, request: Mapping[str, Any]) -> httpx.Response:
        """The response, whose body is not read yet. `file` in the request is the path of its body."""
        ...

    async def read(self, response: httpx.Response) -> bytes: ...

    def chunks(self, response: httpx.Response) -> AsyncGenerator[bytes]: ...

    async def close_response(self, response: httpx.Response) -> None: ...

    async def sleep(self, seconds: float) -> None: ...

    async def close(self) -> None: ...


class BlockingConnection:
    """Connections that block the calling thread."""

    def __init__(self, options: ConnectionOptions) -> None:
        self._client = httpx.Client(**options)

    async def send(self, method: str, path: str, request: Mapping[str, Any]) -> httpx.Response:
        with ExitStack() as files:
            content = _parts(files, request["file"]) if "file" in request else None
            built = self._client.build_request(method, path, content=content, **_arguments(request))
            return self._client.send(built, stream=True)

    async def read(self, response: httpx.Response) -> bytes:
        return response.read()

    async def chunks(self, response: httpx.Response) -> AsyncGenerator[bytes]:
        for chunk in response.iter_bytes():
            yield chunk

    async def close_response(self, response: httpx.Response) -> None:
        response.close()

    async def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    async def close(self) -> None:
        self._client.close()


class AsyncConnection:
    """Connections that leave the event loop to others while they wait."""

    def __init__(self, options: ConnectionOptions) -> None:
        self._client = httpx.AsyncClient(**options)

    async def send(self, method: str, path: str, request: Mapping[str, Any]) -> httpx.Response:
        with ExitStack() as files:
            content = _async_parts(files, request["file"]) if "file" in request else None
            built = self._client.build_request(method, path, content=content, **_arguments(request))
            return await self._client.send(built, stream=True)

    async def read(self, response: httpx.Response) -> bytes:
        return await response.aread()

    async def chunks(self, response: httpx.Response) -> AsyncGenerator[bytes]:
        async for chunk in response.aiter_bytes():
            yield chunk

    async def close_response(self, response: httpx.Response) -> None:
        await response.aclose()

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def close(self) -> None:
        await self._client.aclose()


def _arguments(request: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of httpx, with the length of a body that is read from a file."""
    found = {name: value for name, value in request.items() if name != "file"}
    if "file" in request:
        found["headers"] = {**found.get("headers", {}), "Content-Length": str(request["file"].stat().st_size)}
    return found


def _parts(files: ExitStack, path: Path) -> Iterator[bytes]:
    file = files.enter_context(path.open("rb"))
    yield from iter(lambda: file.read(_PART_BYTES), b"")


async def _async_parts(files: ExitStack, path: Path) -> AsyncGenerator[bytes]:
    for part in _parts(files, path):
        yield part


def finish(coroutine: Coroutine[Any, Any, T]) -> T:
    """The result of a coroutine that never waits for an event loop.

    Raises:
        TypeError: if it does.
    """
    try:
        coroutine.send(None)
    except StopIteration as end:
        return end.value
    coroutine.close()
    raise TypeError("Client calls no asynchronous functions. Use AsyncClient.")


class _Retries:
    """The pauses between the attempts of one request."""

    def __init__(self, limit_seconds: float, stopped: Callable[[], bool], sleep: Callable[[float], Awaitable[None]]):
        self._seconds_left = limit_seconds
        self._stopped, self._sleep = stopped, sleep
        self._step = _FIRST_PAUSE_SECONDS
        self._attempt_began = time.monotonic()

    async def pause(self, problem: str, at_least_seconds: float = 0.0) -> None:
        """Wait before the next attempt. Raises Unavailable with the problem if there shall be none."""
        # with jitter, so that clients that failed together do not retry together
        seconds = max(self._step * random.uniform(0.5, 1.0), at_least_seconds)
        # An attempt counts up to the time that the service has for a response: what is longer is a long upload that
        # breaks off, or a program that was paused meanwhile. Both shall be tried again.
        tried = min(time.monotonic() - self._attempt_began, _TIMEOUT_SECONDS)
        self._seconds_left -= tried + seconds
        if self._seconds_left < 0 or self._stopped():
            raise Unavailable(problem)
        await self._sleep(seconds)
        self._step = min(_LONGEST_PAUSE_SECONDS, 2.0 * self._step)
        self._attempt_began = time.monotonic()


class Http:
    """Requests to /api/v1. A request without a response is repeated, so every request must be safe to repeat."""

    def __init__(
        self,
        connect: Callable[[ConnectionOptions], Connection],
        url: str,
        token: str,
        retry_seconds: float,
        stopped: Callable[[], bool],
    ) -> None:
        """Raises Unavailable if `url` is not an HTTP URL."""
        self._url = url.rstrip("/")
        self._retry_seconds = retry_seconds
        self.stopped = stopped
        if not url.startswith(("http://", "https://")):
            raise Unavailable(f"{url!r} is not the URL of a service, such as http://127.0.0.1:8000.")
        self.connection = connect(
            {
                "base_url": f"{self._url}/api/v1",
                "headers": {"Authorization": f"Bearer {token}"},
                "timeout": _TIMEOUT_SECONDS,
                # A proxy set in the environment cannot reach services on this machine.
                "trust_env": httpx.URL(self._url).host not in _OWN_HOSTS,
            }
        )

    async def request(self, method: str, path: str, **request: Any) -> bytes:
        """The body of the response.

        Args:
            request: arguments of `httpx.Client.request`, or `file`, the path of what to send as the body.

        Raises:
            Refused: if the service refuses the request.
            Unavailable: if it is busy, or does not respond, for too long.
        """
        return await self.receive(self.connection.read, method, path, **request)

    async def receive(
        self, read: Callable[[httpx.Response], Awaitable[T]], method: str, path: str, **request: Any
    ) -> T:
        """What `read` makes of the response; called again with another one if the connection breaks meanwhile.

        Raises:
            Refused, Unavailable: as `request`.
        """
        retries = self._retries()
        while True:
            response = await self._open(retries, method, path, request)
            try:
                return await read(response)
            except httpx.TransportError as error:
                await retries.pause(self._silent(error))
            finally:
                await self.connection.close_response(response)

    async def stream(self, path: str, **request: Any) -> AsyncGenerator[bytes]:
        """The parts of a response as they arrive, until the connection ends.

        Raises:
            Refused, Unavailable: as `request`.
        """
        response = await self._open(self._retries(), "GET", path, request)
        try:
            async for chunk in self.connection.chunks(response):
                yield chunk
        except httpx.TransportError:
            return
        finally:
            await self.connection.close_response(response)

    def _retries(self) -> _Retries:
        return _Retries(self._retry_seconds, self.stopped, self.connection.sleep)

    async def _open(self, retries: _Retries, method: str, path: str, request: Mapping[str, Any]) -> httpx.Response:
        """A successful response, whose body is not read yet."""
        while True:
            try:
                response = await self.connection.send(method, path, request)
            except httpx.TransportError as error:
                await retries.pause(self._silent(error))
                continue
            if response.is_success:
                return response
            try:
                if response.status_code not in _BUSY:
                    raise _refusal(response, await self.connection.read(response))
            finally:
                await self.connection.close_response(response)
            status, seconds = response.status_code, self._retry_seconds
            problem = f"{self._url} is busy: it responded with {status} for {seconds:.0f} s."
            await retries.pause(problem, _retry_after(response))

    def _silent(self, error: httpx.TransportError) -> str:
        return f"{self._url} does not respond ({error}). Is `accord up` running there? Set its address with --url."


def _refusal(response: httpx.Response, body: bytes) -> Refused:
    status = response.status_code
    try:
        error = json.loads(body)["error"]
        return Refused(status, str(error["code"]), str(error["message"]))
    except (ValueError, KeyError, TypeError):
        return Refused(status, "unknown", f"{response.url} responded with {status}. Is it an Accord service?")


def _retry_after(response: httpx.Response) -> float:
    try:
        return float(response.headers.get("Retry-After", "0"))
    except ValueError:
        return 0.0
