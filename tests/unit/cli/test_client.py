import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from accord.cli.client import Api, Refused
from accord.domain.errors import Unavailable

Answer = tuple[int, dict[str, str], object]


class Scripted(HTTPServer):
    """Answers with what it was told, one after the other, and remembers what it was asked."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.answers: list[Answer] = []
        self.asked: list[tuple[str, str, str | None]] = []


class Handler(BaseHTTPRequestHandler):
    server: Scripted

    def do_GET(self) -> None:
        self.server.asked.append((self.command, self.path, self.headers["Authorization"]))
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        status, headers, body = self.server.answers.pop(0)
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
def server() -> Iterator[Scripted]:
    with Scripted() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def api(server: Scripted) -> Iterator[Api]:
    api = Api(f"http://127.0.0.1:{server.server_port}/", "secret", retry_seconds=5.0)
    yield api
    api.close()


def test_it_sends_the_token_and_the_query(server, api):
    server.answers = [(200, {}, {"steps": 3})]
    assert api.get("/experiments", names=["a", "b"]) == {"steps": 3}
    assert server.asked == [("GET", "/api/v1/experiments?names=a&names=b", "Bearer secret")]


def test_it_waits_as_told_when_there_were_too_many_requests(server, api):
    server.answers = [(429, {"Retry-After": "0.01"}, {}), (503, {}, {}), (200, {}, [1])]
    assert api.post("/labels", {"labels": []}) == [1]
    assert len(server.asked) == 3


def test_it_does_not_wait_longer_than_its_patience(server, api):
    server.answers = [(429, {"Retry-After": "3600"}, {})]
    with pytest.raises(Unavailable, match="429"):
        api.get("/me")


def test_a_refusal_is_told_in_the_services_words(server, api):
    error = {"error": {"code": "query_closed", "message": "It is closed.", "details": []}}
    server.answers = [(409, {}, error)]
    with pytest.raises(Refused, match=r"It is closed\.") as caught:
        api.get("/me")
    assert (caught.value.status, caught.value.reason) == (409, "query_closed")


def test_response_of_another_server_is_refused(server, api):
    server.answers = [(404, {}, b"<html>")]
    with pytest.raises(Refused, match="Is it an Accord service"):
        api.get("/me")


def test_unreachable_service_is_unavailable():
    api = Api("http://127.0.0.1:1", "secret", retry_seconds=0.1)
    with pytest.raises(Unavailable, match="does not respond"):
        api.get("/me")
    api.close()


def test_it_gives_up_at_once_when_stopped():
    api = Api("http://127.0.0.1:1", "secret", retry_seconds=3600.0, stopped=lambda: True)
    with pytest.raises(Unavailable):
        api.get("/me")
    api.close()


@pytest.mark.parametrize("url", ["localhost:8000", "", "ftp://x"])
def test_an_address_that_is_not_http_is_refused(url):
    with pytest.raises(Unavailable):
        Api(url, "secret")
