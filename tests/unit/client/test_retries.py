import asyncio
import json
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

from accord.client import AsyncClient, Client, Refused
from accord.domain.errors import Unavailable

#: status, headers and body
Response = tuple[int, dict[str, str], object]


class ScriptedServer(HTTPServer):
    """Returns the given responses in order and records the requests."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.responses: list[Response] = []
        #: method, path and Authorization header
        self.requests: list[tuple[str, str, str | None]] = []
        self.last_event_ids: list[str | None] = []


class Handler(BaseHTTPRequestHandler):
    server: ScriptedServer

    def do_GET(self) -> None:
        self.server.requests.append((self.command, self.path, self.headers["Authorization"]))
        self.server.last_event_ids.append(self.headers["Last-Event-ID"])
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        status, headers, body = self.server.responses.pop(0)
        content = body if isinstance(body, bytes) else json.dumps(body).encode()
        self.send_response(status)
        for name, value in {"Content-Length": str(len(content)), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    do_POST = do_GET

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[ScriptedServer]:
    with ScriptedServer() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture(params=["blocking", "asynchronous"])
def call(request: pytest.FixtureRequest, server: ScriptedServer) -> Callable[..., Any]:
    """Calls a method of a client of the scripted server; of another URL where `url` is given."""

    def call(method: str, *arguments: object, url: str | None = None, **options: Any) -> Any:
        url = url or f"http://127.0.0.1:{server.server_port}/"
        options = {"retry_seconds": 5.0, **options}
        if request.param == "blocking":
            with Client(url, "secret", **options) as client:
                return getattr(client, method)(*arguments)

        async def run() -> Any:
            async with AsyncClient(url, "secret", **options) as client:
                return await getattr(client, method)(*arguments)

        return asyncio.run(run())

    return call


def test_requests_carry_the_token_and_the_query(server, call):
    server.responses = [(200, {}, {"series": []})]
    assert call("metrics", "exp_1", ["a", "b"]).series == []
    assert server.requests == [("GET", "/api/v1/experiments/exp_1/metrics?names=a&names=b", "Bearer secret")]


def test_a_busy_service_is_retried_after_the_time_it_names(server, call):
    server.responses = [(429, {"Retry-After": "0.01"}, {}), (503, {}, {}), (200, {}, [1])]
    assert call("post", "/labels", {"labels": []}) == [1]
    assert len(server.requests) == 3


def test_a_response_that_breaks_off_is_requested_again(server, call, tmp_path):
    server.responses = [(200, {"Content-Length": "9"}, b"half"), (200, {}, b"the whole")]
    call("export", "exp_1", tmp_path / "export.zip")
    assert (tmp_path / "export.zip").read_bytes() == b"the whole"
    assert [path.name for path in tmp_path.iterdir()] == ["export.zip"]


def test_a_request_during_which_the_program_was_paused_is_repeated(server, call, monkeypatch):
    # The clock of a program that is paused for an hour between a request and its response.
    clock = SimpleNamespace(monotonic=lambda: 3600.0 * len(server.requests), sleep=time.sleep)
    monkeypatch.setattr("accord.client.http.time", clock)
    server.responses = [(200, {"Content-Length": "9"}, b"half"), (200, {}, [1])]
    assert call("get", "/me", retry_seconds=60.0) == [1]


def test_a_retry_time_beyond_the_limit_is_not_waited_for(server, call):
    server.responses = [(429, {"Retry-After": "3600"}, {})]
    with pytest.raises(Unavailable):
        call("get", "/me")
    assert len(server.requests) == 1


def test_a_refusal_carries_the_status_code_and_message_of_the_service(server, call):
    error = {"error": {"code": "query_closed", "message": "It is closed.", "details": []}}
    server.responses = [(409, {}, error)]
    with pytest.raises(Refused) as caught:
        call("get", "/me")
    assert (caught.value.status, caught.value.reason, str(caught.value)) == (409, "query_closed", "It is closed.")


def test_a_response_that_is_not_json_is_refused(server, call):
    server.responses = [(404, {}, b"<html>")]
    with pytest.raises(Refused) as caught:
        call("get", "/me")
    assert (caught.value.status, caught.value.reason) == (404, "unknown")


def test_fields_of_a_later_version_of_the_service_are_ignored(server, call):
    server.responses = [(200, {}, {"series": [{"name": "loss", "points": [], "colour": "red"}], "next": None})]
    assert call("metrics", "exp_1").series[0].name == "loss"


def test_an_unreachable_service_is_unavailable(call):
    with pytest.raises(Unavailable):
        call("get", "/me", url="http://127.0.0.1:1", retry_seconds=0.1)


def test_a_stop_ends_retries_at_once(call):
    with pytest.raises(Unavailable):
        call("get", "/me", url="http://127.0.0.1:1", retry_seconds=3600.0, stopped=lambda: True)


@pytest.mark.parametrize("url", ["localhost:8000", "", "ftp://x"])
def test_a_url_that_is_not_http_is_refused(url):
    with pytest.raises(Unavailable):
        Client(url, "secret")


def test_events_continue_after_a_lost_connection(server):
    def stream(number: int) -> bytes:
        points = {"series": [{"name": "loss", "points": [{"step": number, "value": 0.5}]}]}
        return f"id: {number}\r\nevent: metrics\r\ndata: {json.dumps(points)}\r\n\r\n: ping\r\n\r\n".encode()

    server.responses = [(200, {}, stream(1)), (503, {}, {}), (200, {}, stream(2))]
    with Client(f"http://127.0.0.1:{server.server_port}", "secret") as client:
        events = client.events("exp_1")
        steps = [next(events).series[0].points[0].step for _ in range(2)]
        events.close()
    assert steps == [1, 2]
    assert server.last_event_ids == [None, "1", "1"]


def test_the_blocking_client_has_every_method_of_the_asynchronous_one():
    def public(kind: type) -> set[str]:
        return {name for name in vars(kind) if not name.startswith("_")}

    assert public(Client) == public(AsyncClient)
    assert Client.teach.__doc__ == AsyncClient.teach.__doc__


def test_the_blocking_client_calls_no_coroutine_function(server):
    async def judge(first: object, second: object) -> float:
        await asyncio.sleep(0)
        return 1.0

    side = {"segment_id": "seg_1", "clip_id": None, "clip_url": None, "thumbnail_url": None, "seconds": 1, "frames": 5}
    sides = {"left": side | {"index": 0}, "right": side | {"index": 1}}
    query = {"id": "qry_1", "experiment_id": "exp_1", "number": 1, "lease_seconds": 9, **sides}
    arrays = save({name: np.zeros(1) for name in ("observations", "actions", "rewards", "qpos", "qvel")})
    server.responses = [(200, {}, {"items": [query], "reason": ""}), (200, {}, arrays)]
    with Client(f"http://127.0.0.1:{server.server_port}", "secret") as client, pytest.raises(TypeError, match="Async"):
        client.teach("exp_1", judge, 1)
