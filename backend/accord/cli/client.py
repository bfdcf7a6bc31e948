"""A client of the REST API like any other: bearer token, patience, sentences instead of tracebacks."""

import random
import time
from collections.abc import Callable
from typing import Any

import httpx

from accord.domain.errors import AccordError, Unavailable
from accord.workers.runner import Backoff

_OWN_HOSTS = frozenset({"127.0.0.1", "localhost", "::1"})
_BUSY = frozenset({429, 502, 503, 504})
#: a service that starts again is back within this
_PATIENCE_SECONDS = 60.0


class Refused(AccordError):
    """The service answered that it will not do this."""

    def __init__(self, status: int, code: str, message: str) -> None:
        super().__init__(message)
        self.status = status
        #: the API's stable code, not this class's
        self.reason = code


class Api:
    """Calls of /api/v1. Every write it makes is idempotent, so whatever did not answer is asked again."""

    def __init__(
        self, url: str, token: str, *, patience_seconds: float = _PATIENCE_SECONDS, stopped: Callable[[], bool] = bool
    ) -> None:
        """
        Args:
            url: of the service, without /api/v1.
            token: bearer token.
            patience_seconds: how long to go on asking a service that is busy or does not answer.
            stopped: whether to give up at once.

        Raises:
            Unavailable: if the URL is none.
        """
        self._url = url.rstrip("/")
        self._patience_seconds = patience_seconds
        self._stopped = stopped
        self._rng = random.Random()
        if not url.startswith(("http://", "https://")):
            raise Unavailable(f"{url!r} is no URL of a service. One looks like http://127.0.0.1:8000.")
        self._client = httpx.Client(
            base_url=f"{self._url}/api/v1",
            headers={"Authorization": f"Bearer {token}"},
            timeout=30.0,
            # A proxy that the environment names cannot reach this machine's own services.
            trust_env=httpx.URL(self._url).host not in _OWN_HOSTS,
        )

    def get(self, path: str, **query: Any) -> Any:
        """The JSON at `path`. Raises Refused, Unavailable."""
        return _json(self._ask("GET", path, params=query))

    def get_bytes(self, path: str) -> bytes:
        """What is at `path`, as it is. Raises Refused, Unavailable."""
        return self._ask("GET", path).content

    def post(self, path: str, body: Any = None, **query: Any) -> Any:
        """The JSON answer. Raises Refused, Unavailable."""
        return _json(self._ask("POST", path, json=body, params=query))

    def close(self) -> None:
        self._client.close()

    def _ask(self, method: str, path: str, **request: Any) -> httpx.Response:
        deadline = time.monotonic() + self._patience_seconds
        backoff, failures = Backoff(first_seconds=0.2, longest_seconds=5.0), 0
        while True:
            failures += 1
            pause = backoff.seconds(failures, self._rng)
            try:
                response = self._client.request(method, path, **request)
            except httpx.TransportError as error:
                problem = (
                    f"{self._url} does not answer ({error}). Is `accord up` running there? Give its address with --url."
                )
            else:
                if response.status_code not in _BUSY:
                    return _accepted(response)
                problem = f"{self._url} is busy: it answered {response.status_code} for {self._patience_seconds:.0f} s."
                pause = max(pause, _retry_after(response))
            if time.monotonic() + pause > deadline or self._stopped():
                raise Unavailable(problem)
            time.sleep(pause)


def _json(response: httpx.Response) -> Any:
    return response.json() if response.content else None


def _accepted(response: httpx.Response) -> httpx.Response:
    if response.is_success:
        return response
    try:
        error = response.json()["error"]
        code, message = str(error["code"]), str(error["message"])
    except (ValueError, KeyError, TypeError):
        code, message = "unknown", f"{response.request.url} answered {response.status_code}; is it an Accord service?"
    raise Refused(response.status_code, code, message)


def _retry_after(response: httpx.Response) -> float:
    try:
        return float(response.headers.get("Retry-After", "0"))
    except ValueError:
        return 0.0
