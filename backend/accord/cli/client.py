"""A client of the REST API with a bearer token and retries."""

import random
import time
from collections.abc import Callable
from typing import Any

import httpx

from accord.domain.errors import AccordError, Unavailable
from accord.workers.runner import Backoff

_OWN_HOSTS = frozenset({"127.0.0.1", "localhost", "::1"})
_BUSY = frozenset({429, 502, 503, 504})
#: A restarting service responds again within this time.
_RETRY_SECONDS = 60.0


class Refused(AccordError):
    """The service refused a request."""

    def __init__(self, status: int, code: str, message: str) -> None:
        super().__init__(message)
        self.status = status
        #: the `code` of the API's error
        self.reason = code


class Api:
    """Requests to /api/v1. A request without a response is retried, since every write is idempotent."""

    def __init__(
        self, url: str, token: str, *, retry_seconds: float = _RETRY_SECONDS, stopped: Callable[[], bool] = bool
    ) -> None:
        """
        Args:
            url: address of the service, without /api/v1.
            token: bearer token.
            retry_seconds: how long to retry while the service is busy or does not respond.
            stopped: true stops retrying.

        Raises:
            Unavailable: if `url` is not an HTTP URL.
        """
        self._url = url.rstrip("/")
        self._retry_seconds = retry_seconds
        self._stopped = stopped
        self._rng = random.Random()
        if not url.startswith(("http://", "https://")):
            raise Unavailable(f"{url!r} is not the URL of a service, such as http://127.0.0.1:8000.")
        self._client = httpx.Client(
            base_url=f"{self._url}/api/v1",
            headers={"Authorization": f"Bearer {token}"},
            timeout=30.0,
            # A proxy set in the environment cannot reach services on this machine.
            trust_env=httpx.URL(self._url).host not in _OWN_HOSTS,
        )

    def get(self, path: str, **query: Any) -> Any:
        """The JSON at `path`. Raises Refused, Unavailable."""
        return _json(self._request("GET", path, params=query))

    def get_bytes(self, path: str) -> bytes:
        """The bytes at `path`. Raises Refused, Unavailable."""
        return self._request("GET", path).content

    def post(self, path: str, body: Any = None, **query: Any) -> Any:
        """The JSON of the response. Raises Refused, Unavailable."""
        return _json(self._request("POST", path, json=body, params=query))

    def close(self) -> None:
        self._client.close()

    def _request(self, method: str, path: str, **request: Any) -> httpx.Response:
        deadline = time.monotonic() + self._retry_seconds
        backoff, failures = Backoff(first_seconds=0.2, longest_seconds=5.0), 0
        while True:
            failures += 1
            pause = backoff.seconds(failures, self._rng)
            try:
                response = self._client.request(method, path, **request)
            except httpx.TransportError as error:
                problem = (
                    f"{self._url} does not respond ({error}). Is `accord up` running there? Set its address with --url."
                )
            else:
                if response.status_code not in _BUSY:
                    return _accepted(response)
                problem = (
                    f"{self._url} is busy: it responded with {response.status_code} for {self._retry_seconds:.0f} s."
                )
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
        code, message = (
            "unknown",
            f"{response.request.url} responded with {response.status_code}. Is it an Accord service?",
        )
    raise Refused(response.status_code, code, message)


def _retry_after(response: httpx.Response) -> float:
    try:
        return float(response.headers.get("Retry-After", "0"))
    except ValueError:
        return 0.0
