"""Clients that send or read slowly, or hold many connections, do not keep the service from others."""

import io
import resource
import socket
import time
import zipfile
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import psutil
import pytest

from accord.api.connections import LEAST_TRANSFER_BYTES
from accord.domain.enums import Role
from accord.domain.ids import new_id
from accord.store.tables import ClipRow
from support.api_in_thread import ApiServer, client, run_api_server
from support.api_process import running_server
from support.plain_http import PLAIN_HTTP
from support.sample_experiments import create_sample
from support.stores import Stores
from support.waiting import PATIENCE_SECONDS, until

REQUEST_SECONDS, TRANSFER_SECONDS = 0.5, 1.0
HALF = b"GET /api/v1/health HTTP/1.1\r\nHost: localhost\r\n"


@pytest.fixture
def impatient(sqlite: Stores, tmp_path: Path) -> Generator[ApiServer]:
    """A server with short timeouts."""
    with run_api_server(
        sqlite, tmp_path, request_timeout_seconds=REQUEST_SECONDS, transfer_timeout_seconds=TRANSFER_SECONDS
    ) as api:
        yield api


def connect(url: str) -> socket.socket:
    address = urlsplit(url)
    assert address.hostname is not None
    return socket.create_connection((address.hostname, address.port or 0), PATIENCE_SECONDS)


def post(token: str | None, length: int, path: str = f"/api/v1/queries/{new_id('qry')}/label") -> bytes:
    """The headers of a request with a body of `length` bytes."""
    authorization = f"Authorization: Bearer {token}\r\n" if token else ""
    return f"PUT {path} HTTP/1.1\r\nHost: localhost\r\n{authorization}Content-Length: {length}\r\n\r\n".encode()


def received(connection: socket.socket) -> bytes:
    """Everything that the server sends until it closes the connection."""
    content = b""
    with suppress(ConnectionResetError):
        while part := connection.recv(65_536):
            content += part
    return content


def test_connection_without_a_whole_request_is_closed(impatient: ApiServer) -> None:
    for sent in (b"", HALF, post(impatient.tokens[Role.TEACHER], 100)):
        with connect(impatient.url) as connection:
            connection.sendall(sent)
            assert received(connection) == b""


@pytest.mark.parametrize("before", [b"", b"HEAD /nothing HTTP/1.1\r\nHost: localhost\r\n\r\n"])
def test_connection_that_sends_headers_byte_by_byte_is_closed(impatient: ApiServer, before: bytes) -> None:
    with connect(impatient.url) as connection:
        connection.sendall(before + HALF)
        connection.sendall(b"X-Slow: ")

        def refused() -> bool:
            try:
                connection.sendall(b"x")
            except ConnectionError:
                return True
            return False

        until(refused, "the server closes the connection")


def test_others_are_served_while_as_many_connections_wait_as_are_allowed(sqlite: Stores, tmp_path: Path) -> None:
    with run_api_server(sqlite, tmp_path, max_connections=20) as api, ExitStack() as connections:
        silent = [connections.enter_context(connect(api.url)) for _ in range(60)]
        for connection in silent:
            with suppress(ConnectionError):
                connection.sendall(HALF)
        for _ in range(30):
            # each over a connection of its own
            assert httpx.get(f"{api.url}/api/v1/health", timeout=PATIENCE_SECONDS, **PLAIN_HTTP).is_success
        assert received(silent[0]) == b""


@contextmanager
def descriptors(limit: int) -> Iterator[None]:
    """Processes that start in the block may open this many files."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.slow
def test_more_half_sent_requests_than_file_descriptors_keep_nobody_out(tmp_path: Path) -> None:
    if resource.getrlimit(resource.RLIMIT_NOFILE)[0] < 2000:
        pytest.skip("the limit of open files (ulimit -n) is below 2000")
    with ExitStack() as stack:
        with descriptors(1024):
            server = stack.enter_context(running_server(tmp_path))
        for _ in range(1100):
            connection = stack.enter_context(connect(server.url))
            with suppress(ConnectionError):
                connection.sendall(HALF)
        for _ in range(5):
            assert httpx.get(f"{server.url}/api/v1/health", timeout=PATIENCE_SECONDS, **PLAIN_HTTP).is_success
        assert "Traceback" not in server.log.read_text()


def test_body_is_not_read_before_the_token_is_verified(api: ApiServer) -> None:
    for token in (None, "wrong"):
        with connect(api.url) as connection:
            connection.sendall(post(token, 1_900_000) + b" " * 1000)
            assert received(connection).startswith(b"HTTP/1.1 401 ")


def test_new_member_sends_a_small_body_without_a_token(api: ApiServer) -> None:
    path = "/api/v1/join/none"
    assert api.anyone.post(path, json={"name": "Ada"}).json()["error"]["code"] == "invitation_not_valid"
    assert api.anyone.post(path, json={"name": "A" * 20_000}).json()["error"]["code"] == "body_too_large"


def test_body_that_stops_is_refused(impatient: ApiServer) -> None:
    with connect(impatient.url) as connection:
        connection.sendall(post(impatient.tokens[Role.TEACHER], 100_000) + b" " * 1000)
        answer = received(connection)
    assert answer.startswith(b"HTTP/1.1 408 ")
    assert b"body_too_slow" in answer


def test_slow_upload_that_makes_progress_is_accepted(impatient: ApiServer) -> None:
    with io.BytesIO() as archive:
        with zipfile.ZipFile(archive, "w") as file:
            file.writestr("labels.parquet", bytes(12 * LEAST_TRANSFER_BYTES))
        content = archive.getvalue()

    def slowly() -> Iterator[bytes]:
        for start in range(0, len(content), LEAST_TRANSFER_BYTES):
            yield content[start : start + LEAST_TRANSFER_BYTES]
            time.sleep(TRANSFER_SECONDS / 4)

    started = time.monotonic()
    response = impatient.researcher.post("/api/v1/experiments/import?name=slow", content=slowly())
    assert time.monotonic() - started > 2 * TRANSFER_SECONDS
    assert (response.status_code, response.json()["error"]["code"]) == (422, "invalid")


def is_open_at_server(client_port: int) -> bool:
    return any(
        each.raddr and each.raddr.port == client_port and each.status == psutil.CONN_ESTABLISHED
        for each in psutil.Process().net_connections("tcp4")
    )


def test_client_that_does_not_read_is_disconnected(impatient: ApiServer) -> None:
    size = 30_000_000
    stores = impatient.stores
    sample = create_sample(stores.database, stores.blobs)
    with stores.database.transaction() as session:
        clip = session.query(ClipRow).filter(ClipRow.experiment_id == sample.experiment.id).first()
        assert clip is not None
        clip.blob_key, clip.size_bytes = "clips/large.mp4", size
        path = f"/api/v1/clips/{clip.id}.mp4"
    stores.blobs.put("clips/large.mp4", bytes(size))
    with connect(impatient.url) as connection:
        connection.sendall(
            f"GET {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {sample.owner_token}\r\n\r\n".encode()
        )
        assert connection.recv(1, socket.MSG_PEEK)
        port = connection.getsockname()[1]
        # what a client that reads nothing waits for; reading would be the progress that the server wants to see
        until(lambda: not is_open_at_server(port), "the server closes the connection")
        assert len(received(connection)) < size
    # One that reads slowly gets everything.
    with impatient.client(sample.owner_token) as reader, reader.stream("GET", path) as response:
        read = 0
        for part in response.iter_raw(size // 10):
            read += len(part)
            time.sleep(TRANSFER_SECONDS / 4)
    assert read == size


def test_event_stream_is_not_cut(impatient: ApiServer) -> None:
    sample = create_sample(impatient.stores.database, impatient.stores.blobs)
    path = f"/api/v1/experiments/{sample.experiment.id}"
    with impatient.client(sample.owner_token) as follower, follower.stream("GET", f"{path}/events") as stream:
        lines = stream.iter_lines()
        assert next(lines).startswith("id:")
        time.sleep(2 * (REQUEST_SECONDS + TRANSFER_SECONDS))
        assert impatient.researcher.post(f"{path}/pause").is_success
        while '"paused"' not in next(lines):
            pass


def test_idle_connections_are_closed_for_new_ones(sqlite: Stores, tmp_path: Path) -> None:
    with run_api_server(sqlite, tmp_path, max_connections=10) as api, ExitStack() as clients:
        token = api.tokens[Role.LABELLER]
        many = [clients.enter_context(client(api.url, token)) for _ in range(30)]
        for each in many:
            assert each.get("/api/v1/me").is_success
