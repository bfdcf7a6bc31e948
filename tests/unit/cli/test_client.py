import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from accord.cli.client import Api, Refused
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


class Handler(BaseHTTPRequestHandler):
    server: ScriptedServer

    def do_GET(self) -> None:
        self.server.requests.append((self.command, self.path, self.headers["Authorization"]))
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        status, headers, body = self.server.responses.pop(0)
        content = body if isinstance(body, bytes) else json.dumps(body).encode()
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(content))}.items():
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


@pytest.fixture
def api(server: ScriptedServer) -> Iterator[Api]:
    api = Api(f"http://127.0.0.1:{server.server_port}/", "secret", retry_seconds=5.0)
    yield api
    api.close()


def test_requests_carry_the_token_and_the_query(server, api):
    server.responses = [(200, {}, {"steps": 3})]
    assert api.get("/experiments", names=["a", "b"]) == {"steps": 3}
    assert server.requests == [("GET", "/api/v1/experiments?names=a&names=b", "Bearer secret")]


def test_a_busy_service_is_retried_after_the_time_it_names(server, api):
    server.responses = [(429, {"Retry-After": "0.01"}, {}), (503, {}, {}), (200, {}, [1])]
    assert api.post("/labels", {"labels": []}) == [1]
    assert len(server.requests) == 3


def test_a_retry_time_beyond_the_limit_is_not_waited_for(server, api):
    server.responses = [(429, {"Retry-After": "3600"}, {})]
    with pytest.raises(Unavailable):
        api.get("/me")
    assert len(server.requests) == 1


def test_a_refusal_carries_the_status_code_and_message_of_the_service(server, api):
    error = {"error": {"code": "query_closed", "message": "It is closed.", "details": []}}
    server.responses = [(409, {}, error)]
    with pytest.raises(Refused) as caught:
        api.get("/me")
    assert (caught.value.status, caught.value.reason, str(caught.value)) == (409, "query_closed", "It is closed.")


def test_a_response_that_is_not_json_is_refused(server, api):
    server.responses = [(404, {}, b"<html>")]
    with pytest.raises(Refused) as caught:
        api.get("/me")
    assert (caught.value.status, caught.value.reason) == (404, "unknown")


def test_an_unreachable_service_is_unavailable():
    api = Api("http://127.0.0.1:1", "secret", retry_seconds=0.1)
    with pytest.raises(Unavailable):
        api.get("/me")
    api.close()


def test_a_stop_ends_retries_at_once():
    api = Api("http://127.0.0.1:1", "secret", retry_seconds=3600.0, stopped=lambda: True)
    with pytest.raises(Unavailable):
        api.get("/me")
    api.close()


@pytest.mark.parametrize("url", ["localhost:8000", "", "ftp://x"])
def test_a_url_that_is_not_http_is_refused(url):
    with pytest.raises(Unavailable):
        Api(url, "secret")
