"""Only a server that keeps silent twice in a row hangs, not one that is slow, refuses or restarts."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest

from accord.cli.api_watch import ApiWatch
from support.waiting import until

TIMEOUT_SECONDS = 2.0
PID, OTHER_PID = 100, 101
Answer = Callable[[socket.socket], None]


class Server:
    """Accepts connections and treats each one as `answer` says."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.answer: Answer = ok
        self.requests = 0
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self.listener.accept()
                self.requests += 1
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with connection, suppress(OSError):
            self.answer(connection)

    def after(self, n_requests: int) -> None:
        """Wait for as many further requests."""
        wanted = self.requests + n_requests
        until(lambda: self.requests >= wanted)


def ok(connection: socket.socket) -> None:
    connection.recv(1000)
    connection.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")


def late(connection: socket.socket) -> None:
    time.sleep(TIMEOUT_SECONDS / 10)
    ok(connection)


def unavailable(connection: socket.socket) -> None:
    connection.recv(1000)
    connection.sendall(b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\n\r\n")


def closed(connection: socket.socket) -> None:
    connection.recv(1000)


def silent(connection: socket.socket) -> None:
    connection.recv(1000)
    time.sleep(20 * TIMEOUT_SECONDS)


@pytest.fixture
def server() -> Iterator[Server]:
    created = Server()
    yield created
    created.listener.close()


def watch(server: Server) -> ApiWatch:
    return ApiWatch(f"http://127.0.0.1:{server.listener.getsockname()[1]}", TIMEOUT_SECONDS)


def test_silent_process_hangs_after_it_answered(server: Server) -> None:
    watched = watch(server)
    assert not watched.hangs(PID)
    server.after(2)
    server.answer = silent
    until(lambda: watched.hangs(PID))
    # Its successor is judged anew.
    assert not watched.hangs(OTHER_PID)


@pytest.mark.parametrize("answer", [late, unavailable, closed])
def test_process_that_answers_somehow_does_not_hang(server: Server, answer: Answer) -> None:
    server.answer = answer
    watched = watch(server)
    for _ in range(5):
        assert not watched.hangs(PID)
        server.after(1)


def test_process_that_is_silent_once_does_not_hang(server: Server) -> None:
    watched = watch(server)
    watched.hangs(PID)
    server.after(2)

    def every_other(connection: socket.socket) -> None:
        (silent if server.requests % 2 else ok)(connection)

    server.answer = every_other
    for _ in range(4):
        server.after(1)
        assert not watched.hangs(PID)


def test_process_that_has_not_answered_yet_may_be_starting(server: Server) -> None:
    server.answer = silent
    watched = watch(server)
    for _ in range(4):
        assert not watched.hangs(PID)
        server.after(1)
