"""Round trips of honest labellers while strangers attack the server's process, beside those without an attack.

- slow clients: 1,100 half-sent requests, opened again when the server closes them, with `ulimit -n 1024`
- wrong tokens: 8 connections that send wrong bearer tokens and open wrong sign-in links as fast as they can
- large bodies: 200 connections that send 1.9 MB with a wrong token, without the last byte

    python tests/benchmarks/bench_attacks.py [--labellers 4] [--seconds 6]
"""

import argparse
import multiprocessing
import resource
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.synchronize import Event
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

import httpx
import numpy as np
import psutil
from bench_labels import prepare

from support.api_process import running_server
from support.plain_http import PLAIN_HTTP

SLOW_CLIENTS, TOKEN_CLIENTS, BODIES = 1100, 8, 200
BODY_BYTES = 1_900_000
#: a request that takes longer counts as failed
TIMEOUT_SECONDS = 5.0


def slow_clients(port: int, stop: Event) -> None:
    open_sockets: list[socket.socket] = []
    while not stop.is_set():
        while len(open_sockets) < SLOW_CLIENTS and not stop.is_set():
            with suppress(OSError):
                connection = socket.create_connection(("127.0.0.1", port), timeout=1)
                connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
                connection.setblocking(False)
                open_sockets.append(connection)
        time.sleep(0.2)
        open_sockets = [each for each in open_sockets if _is_open(each)]


def _is_open(connection: socket.socket) -> bool:
    try:
        return connection.recv(1000) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


def wrong_tokens(port: int, stop: Event) -> None:
    def attack(number: int) -> None:
        while not stop.is_set():
            with suppress(httpx.HTTPError), httpx.Client(base_url=f"http://127.0.0.1:{port}", **PLAIN_HTTP) as client:
                while not stop.is_set():
                    client.post("/api/v1/sign-out", headers={"Authorization": f"Bearer {number}"})
                    client.post(f"/api/v1/sign-in/{number}")

    threads = [threading.Thread(target=attack, args=(number,)) for number in range(TOKEN_CLIENTS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def large_bodies(port: int, stop: Event) -> None:
    head = "PUT /api/v1/queries/x/label HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer x\r\n"
    head += f"Content-Length: {BODY_BYTES}\r\n\r\n"
    open_sockets: list[socket.socket] = []
    for _ in range(BODIES):
        with suppress(OSError):
            connection = socket.create_connection(("127.0.0.1", port), timeout=5)
            open_sockets.append(connection)
            connection.sendall(head.encode() + bytes(BODY_BYTES - 1))
    stop.wait()


def label(url: str, token: str, experiment_id: str, seconds: float, times: list[float], failures: list[str]) -> None:
    """Label as a page does, over one connection where the server keeps it."""
    end = time.monotonic() + seconds
    with httpx.Client(
        base_url=url, headers={"Authorization": f"Bearer {token}"}, timeout=TIMEOUT_SECONDS, **PLAIN_HTTP
    ) as client:
        while time.monotonic() < end:
            started = time.perf_counter()
            try:
                found = client.post(f"/api/v1/experiments/{experiment_id}/queries/next")
                query = found.raise_for_status().json()["items"][0]["id"]
                client.put(f"/api/v1/queries/{query}/label", json={"label": 1}).raise_for_status()
                times.append(time.perf_counter() - started)
            except httpx.HTTPError as error:
                failures.append(type(error).__name__)
            time.sleep(0.05)


def measure(name: str, attack: Callable[[int, Event], None] | None, labellers: int, seconds: float) -> None:
    spawn = multiprocessing.get_context("spawn")
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    with tempfile.TemporaryDirectory(prefix="accord-bench-") as folder:
        experiment_id, tokens = prepare(Path(folder), labellers)
        resource.setrlimit(resource.RLIMIT_NOFILE, (1024, hard))
        with running_server(Path(folder)) as server:
            resource.setrlimit(resource.RLIMIT_NOFILE, (4096, hard))
            port, stop = int(server.url.rpartition(":")[2]), spawn.Event()
            for token in tokens:  # they are signed in when the attack begins
                httpx.get(f"{server.url}/api/v1/me", headers={"Authorization": f"Bearer {token}"}, **PLAIN_HTTP)
            before = psutil.Process(server.process.pid).memory_info().rss
            attacker = spawn.Process(target=attack, args=(port, stop)) if attack else None
            if attacker:
                attacker.start()
                time.sleep(3)
            times: list[float] = []
            failures: list[str] = []
            threads = [
                threading.Thread(target=label, args=(server.url, token, experiment_id, seconds, times, failures))
                for token in tokens
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            grown = psutil.Process(server.process.pid).memory_info().rss - before
            stop.set()
            if attacker:
                attacker.join()
    p50, p95 = np.percentile(np.array(times or [np.nan]) * 1000, [50, 95])
    print(
        f"{name:<14} {len(times):6} round trips   p50 {p50:7.1f} ms   p95 {p95:7.1f} ms   "
        f"{len(failures):4} failed   server +{grown / 1e6:.0f} MB"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--labellers", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=6.0)
    arguments = parser.parse_args()
    for name, attack in (
        ("no attack", None),
        ("slow clients", slow_clients),
        ("wrong tokens", wrong_tokens),
        ("large bodies", large_bodies),
    ):
        measure(name, attack, arguments.labellers, arguments.seconds)


if __name__ == "__main__":
    main()
