"""Label round trips per second of a server process with 16 labellers and SQLite with synchronous=FULL.

A round trip is `queries/next` and then `PUT label`: two HTTP requests and two committed transactions. Two upper bounds
are measured in the same run: requests of as many clients to an empty FastAPI route, and consecutive transactions of
SQLite alone.

    python tests/benchmarks/bench_labels.py [--clients 16] [--seconds 8]
"""

import argparse
import multiprocessing
import os
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
from multiprocessing.synchronize import Barrier
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

import numpy as np
import psutil

from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database
from accord.store.migrate import migrate
from support.api_process import running_server
from support.sample_experiments import create_sample, user

#: enough for a server several times as fast as now
SEGMENTS, QUERIES = 190, 17_000
_BARE = """
import socket, sys, uvicorn
from fastapi import FastAPI
app = FastAPI()
@app.get("/")
def empty():
    return {"ok": True}
listener = socket.socket()
listener.bind(("127.0.0.1", 0))
listener.listen(256)
print(listener.getsockname()[1], flush=True)
uvicorn.Server(uvicorn.Config(app, log_level="warning", access_log=False)).run([listener])
"""


class Client:
    """A minimal HTTP client, which takes little CPU time from the server."""

    def __init__(self, port: int, token: str) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=30)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._head = f"Host: 127.0.0.1\r\nAuthorization: Bearer {token}\r\nContent-Type: application/json\r\n".encode()

    def request(self, method: bytes, path: bytes, body: bytes = b"") -> tuple[int, bytes]:
        self._socket.sendall(
            b"%b %b HTTP/1.1\r\n%bContent-Length: %d\r\n\r\n%b" % (method, path, self._head, len(body), body)
        )
        received = self._socket.recv(65_536)
        while b"\r\n\r\n" not in received:
            received += self._socket.recv(65_536)
        head, _, content = received.partition(b"\r\n\r\n")
        length = int(head.lower().partition(b"content-length: ")[2].split(b"\r\n", 1)[0])
        while len(content) < length:
            content += self._socket.recv(65_536)
        return int(head[9:12]), content


def label_until(port: int, token: str, experiment_id: str, seconds: float, start: Barrier, times: list[float]) -> None:
    """Label queries. `times` gets the seconds of every request, alternately for `next` and for `PUT label`."""
    client = Client(port, token)
    next_path = f"/api/v1/experiments/{experiment_id}/queries/next".encode()
    start.wait()
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        started = time.perf_counter()
        status, content = client.request(b"POST", next_path)
        query_received = time.perf_counter()
        query_id = content.partition(b'"items":[{"id":"')[2].partition(b'"')[0]
        if status != 200 or not query_id:
            raise RuntimeError(f"next answered {status}: {content[:300]!r}")
        body = b'{"label":1,"order":"shown","response_seconds":1.5}'
        status, content = client.request(b"PUT", b"/api/v1/queries/%b/label" % query_id, body)
        if status != 201:
            raise RuntimeError(f"label answered {status}: {content[:300]!r}")
        times += [query_received - started, time.perf_counter() - query_received]


def request_until(
    port: int, token: str, _experiment_id: str, seconds: float, start: Barrier, times: list[float]
) -> None:
    """Request an empty route. `times` gets the seconds of every request."""
    client = Client(port, token)
    start.wait()
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        started = time.perf_counter()
        client.request(b"GET", b"/")
        times.append(time.perf_counter() - started)


def _client_process(work, port, token, experiment_id, seconds, start, results) -> None:
    times: list[float] = []
    try:
        work(port, token, experiment_id, seconds, start, times)
    finally:
        results.put(times)


def drive(work, port: int, tokens: list[str], experiment_id: str, seconds: float) -> tuple[float, list[list[float]]]:
    """Run one client process per token; return the total duration and the times of each client."""
    spawn = multiprocessing.get_context("spawn")
    start, results = spawn.Barrier(len(tokens) + 1), spawn.Queue()
    processes = [
        spawn.Process(target=_client_process, args=(work, port, token, experiment_id, seconds, start, results))
        for token in tokens
    ]
    for process in processes:
        process.start()
    start.wait(120)
    started = time.perf_counter()
    times = [results.get(timeout=seconds + 60) for _ in processes]
    taken = time.perf_counter() - started
    for process in processes:
        process.join()
        if process.exitcode:
            raise RuntimeError("a client failed")
    return taken, times


def bare_requests(clients: int, seconds: float) -> float:
    """Requests per second of an empty FastAPI route with the same server and clients."""
    with subprocess.Popen([sys.executable, "-c", _BARE], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            port = int(process.stdout.readline())
            taken, times = drive(request_until, port, ["none"] * clients, "", seconds)
        finally:
            process.kill()
    return sum(map(len, times)) / taken


def bare_transactions(folder: Path, seconds: float) -> float:
    """Transactions per second of one connection. Each reads and changes a row and inserts another."""
    connection = sqlite3.connect(folder / "bare.db", isolation_level=None)
    for statement in (
        "PRAGMA journal_mode = WAL",
        "PRAGMA synchronous = FULL",
        "CREATE TABLE counter (n INTEGER)",
        "INSERT INTO counter VALUES (0)",
        "CREATE TABLE entry (id INTEGER PRIMARY KEY, n INTEGER, text TEXT)",
    ):
        connection.execute(statement)
    count, end = 0, time.perf_counter() + seconds
    while time.perf_counter() < end:
        connection.execute("BEGIN IMMEDIATE")
        (n,) = connection.execute("SELECT n FROM counter").fetchone()
        connection.execute("UPDATE counter SET n = ?", (n + 1,))
        connection.execute("INSERT INTO entry (n, text) VALUES (?, ?)", (n, "x" * 100))
        connection.execute("COMMIT")
        count += 1
    connection.close()
    return count / seconds


def prepare(home: Path, clients: int) -> tuple[str, list[str]]:
    """Create a database with open queries; return the id of the experiment and one token per client."""
    settings = Settings(home=home)
    database, blobs = Database.open(settings.resolved_database_url), open_blobs(settings.resolved_blob_url)
    migrate(database)
    sample = create_sample(
        database,
        blobs,
        segments=SEGMENTS,
        queries=QUERIES,
        label_budget=QUERIES,
        initial_labels=QUERIES,
        lookahead_queries=8,
    )
    with database.transaction() as session:
        tokens = [user(session, f"labeller {number}")[1] for number in range(clients)]
    database.close()
    return sample.experiment.id, tokens


def cpu_seconds(pid: int) -> float:
    """User and system CPU time of a process."""
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=8.0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="accord-bench-") as folder:
        home = Path(folder)
        experiment_id, tokens = prepare(home, arguments.clients)
        transactions = bare_transactions(home, arguments.seconds / 2)
        requests = bare_requests(arguments.clients, arguments.seconds / 2)
        with running_server(home) as server:
            port = int(server.url.rpartition(":")[2])
            before = cpu_seconds(server.process.pid)
            taken, times = drive(label_until, port, tokens, experiment_id, arguments.seconds)
            server_cpu = cpu_seconds(server.process.pid) - before
        with sqlite3.connect(home / "accord.db") as connection:
            (stored,) = connection.execute("SELECT label_count FROM experiments").fetchone()
        connection.close()
    trips = sum(map(len, times)) // 2
    assert stored == trips, f"{trips} labels acknowledged, {stored} stored"
    nexts = np.concatenate([each[0::2] for each in times]) * 1000
    puts = np.concatenate([each[1::2] for each in times]) * 1000
    rounds = nexts + puts
    print(f"{arguments.clients} clients, {os.cpu_count()} cores, {taken:.1f} s, SQLite WAL, synchronous=FULL")
    print(f"label round trips/s            {trips / taken:8.0f}   ({trips} labels acknowledged, {stored} stored)")
    for name, values in (("round trip", rounds), ("  next", nexts), ("  put", puts)):
        p50, p99 = np.percentile(values, [50, 99])
        print(f"{name:<12} p50 {p50:7.1f} ms   p99 {p99:7.1f} ms   max {values.max():7.1f} ms")
    print(f"server CPU                     {1000 * server_cpu / trips:8.2f} ms per round trip")
    print(f"ceiling: empty FastAPI route   {requests:8.0f} requests/s ({requests / 2:.0f} pairs of requests/s)")
    print(f"ceiling: SQLite alone          {transactions:8.0f} transactions/s ({transactions / 2:.0f} pairs/s)")


if __name__ == "__main__":
    main()
