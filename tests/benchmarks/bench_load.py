"""Labelling by many people at once: cycles per second and latencies, with SQLite and with PostgreSQL.

A cycle is `queries/next` and then `PUT label`, each with a committed transaction; every labeller begins the next one at
once. With streams, every labeller also has an event stream open, as the page has. One server process serves them; all
clients together are one process. PostgreSQL runs with fsync, SQLite with synchronous=FULL.

    python tests/benchmarks/bench_load.py [--labellers 1,16,64,200] [--databases sqlite,postgres] [--seconds 6]
"""

import argparse
import multiprocessing
import os
import selectors
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

import numpy as np
import psutil

from support.api_process import running_server
from support.sample_experiments import create_sample, user
from support.stores import PostgresServer, Stores, migrated_postgres_database, open_stores

#: Labels per second that the queries of one measurement last for.
MOST_PER_SECOND = 900
LABEL = b'{"label":1,"order":"shown","response_seconds":1.5}'


@dataclass(slots=True)
class Labeller:
    """One person's connection, which asks and labels in turn."""

    socket: socket.socket
    head: bytes
    next_path: bytes
    received: bytes = b""
    asked_at: float = 0.0
    labels: bool = False
    #: seconds of whole cycles
    cycles: list[float] = field(default_factory=list)

    def ask(self) -> None:
        self.labels = False
        self.asked_at = time.perf_counter()
        self._send(b"POST", self.next_path, b"")

    def read(self) -> None:
        """Read what has arrived; with a whole response, send the next request."""
        self.received += self.socket.recv(65_536)
        head, found, content = self.received.partition(b"\r\n\r\n")
        if not found or len(content) < int(head.lower().partition(b"content-length: ")[2].split(b"\r\n", 1)[0]):
            return
        self.received = b""
        if int(head[9:12]) != (201 if self.labels else 200):
            raise RuntimeError(f"the server answered {head[:200]!r} {content[:300]!r}")
        if self.labels:
            self.cycles.append(time.perf_counter() - self.asked_at)
            self.ask()
            return
        query = content.partition(b'"items":[{"id":"')[2].partition(b'"')[0]
        if not query:
            raise RuntimeError(f"no query is open: {content[:300]!r}")
        self.labels = True
        self._send(b"PUT", b"/api/v1/queries/%b/label" % query, LABEL)

    def _send(self, method: bytes, path: bytes, body: bytes) -> None:
        self.socket.sendall(
            b"%b %b HTTP/1.1\r\n%bContent-Length: %d\r\n\r\n%b" % (method, path, self.head, len(body), body)
        )


def _connect(port: int) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=60)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def label_all(
    port: int, tokens: list[str], experiment: str, seconds: float, streams: bool, results: Connection
) -> None:
    """Label with every token until the time is over. Sends the cycles of all and the number of bytes of streams."""
    path = f"/api/v1/experiments/{experiment}".encode()
    selector = selectors.DefaultSelector()
    labellers: list[Labeller] = []
    for token in tokens:
        head = f"Host: 127.0.0.1\r\nAuthorization: Bearer {token}\r\n".encode()
        if streams:
            stream = _connect(port)
            stream.sendall(b"GET %b/events?max_points=300 HTTP/1.1\r\n%b\r\n" % (path, head))
            if not stream.recv(12).endswith(b" 200"):
                raise RuntimeError("an event stream was refused")
            selector.register(stream, selectors.EVENT_READ, None)
        head += b"Content-Type: application/json\r\n"
        labellers.append(Labeller(_connect(port), head, path + b"/queries/next"))
    for labeller in labellers:
        selector.register(labeller.socket, selectors.EVENT_READ, labeller)
        labeller.ask()
    end, pushed = time.perf_counter() + seconds, 0
    while time.perf_counter() < end:
        for key, _ in selector.select(1.0):
            if key.data is not None:
                key.data.read()
            elif isinstance(key.fileobj, socket.socket):
                pushed += len(key.fileobj.recv(262_144))
    results.send(([each.cycles for each in labellers], pushed))


@dataclass(frozen=True, slots=True)
class Load:
    """What one measurement found."""

    #: seconds of each cycle
    cycles: np.ndarray
    cycles_per_second: float
    server_cpu_seconds: float
    stream_bytes_per_second: float

    def line(self) -> str:
        p50, p95, p99 = np.percentile(self.cycles * 1000, [50, 95, 99])
        cpu = 1000 * self.server_cpu_seconds / len(self.cycles)
        return (
            f"{self.cycles_per_second:6.0f} cycles/s   p50 {p50:6.1f} ms   p95 {p95:6.1f} ms   p99 {p99:6.1f} ms   "
            f"server CPU {cpu:5.2f} ms a cycle   streams {self.stream_bytes_per_second / 1000:6.0f} kB/s"
        )


def measure(stores: Stores, home: Path, tokens: list[str], seconds: float, streams: bool) -> Load:
    """Label an experiment of its own over a server process of its own; every acknowledged label must be stored."""
    queries = int(MOST_PER_SECOND * seconds)
    sample = create_sample(
        stores.database,
        stores.blobs,
        segments=int((2 * queries) ** 0.5) + 2,
        queries=queries,
        label_budget=queries,
        initial_labels=queries,
        lookahead_queries=8,
    )
    environment = {"ACCORD_DATABASE_URL": stores.database_url, "ACCORD_BLOB_URL": stores.blob_url}
    spawn = multiprocessing.get_context("spawn")
    with running_server(home, environment) as server:
        port = int(server.url.rpartition(":")[2])
        receiver, sender = spawn.Pipe(duplex=False)
        arguments = (port, tokens, sample.experiment.id, seconds, streams, sender)
        process = psutil.Process(server.process.pid)
        client = spawn.Process(target=label_all, args=arguments)
        before = process.cpu_times()
        client.start()
        sender.close()
        cycles, pushed = receiver.recv()
        client.join()
        after = process.cpu_times()
        server.stop()
    with stores.database.reading() as session:
        session.add(sample.experiment)
        session.refresh(sample.experiment)
        stored = sample.experiment.label_count
    times = np.concatenate(cycles)
    # The last label of each connection may have been stored without having been acknowledged.
    assert len(times) <= stored <= len(times) + len(tokens), f"{len(times)} acknowledged, {stored} stored"
    cpu = after.user + after.system - before.user - before.system
    return Load(times, len(times) / seconds, cpu, pushed / seconds)


@contextmanager
def database_url(name: str) -> Iterator[str]:
    """The URL of an empty, migrated database on a durable PostgreSQL server; empty for SQLite."""
    if name == "sqlite":
        yield ""
        return
    with PostgresServer(durable=True) as server, migrated_postgres_database(server.url, "load") as url:
        yield url


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--labellers", default="1,16,64,200", help="comma-separated numbers of labellers")
    parser.add_argument("--databases", default="sqlite,postgres", help="sqlite, postgres or both")
    parser.add_argument("--seconds", type=float, default=6.0, help="duration of each measurement")
    options = parser.parse_args()
    counts = [int(count) for count in options.labellers.split(",")]
    print(f"{os.cpu_count()} cores, {options.seconds:g} s each, one server process")
    for name in options.databases.split(","):
        with (
            tempfile.TemporaryDirectory(prefix="accord-bench-") as folder,
            database_url(name) as url,
            open_stores(Path(folder), url) as stores,
        ):
            with stores.database.transaction() as session:
                tokens = [user(session, f"labeller {number}")[1] for number in range(max(counts))]
            for count in counts:
                found: dict[bool, Load] = {}
                for streams in (False, True):
                    found[streams] = measure(stores, Path(folder), tokens[:count], options.seconds, streams)
                    with_streams = "with streams" if streams else "no streams"
                    print(f"{name:<9}{count:4} labellers, {with_streams:<13}{found[streams].line()}", flush=True)
                share = found[True].cycles_per_second / found[False].cycles_per_second
                print(f"{name:<9}{count:4} labellers: with streams {share:.0%} of the cycles without", flush=True)


if __name__ == "__main__":
    main()
