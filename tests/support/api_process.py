"""The real server as a child process on a free port."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import httpx

from support.plain_http import PLAIN_HTTP
from support.waiting import PATIENCE_SECONDS


@dataclass(frozen=True, slots=True)
class Server:
    """A server process that accepts requests."""

    process: subprocess.Popen[bytes]
    url: str
    log: Path

    def stop(self, timeout_seconds: float = PATIENCE_SECONDS) -> int:
        """Send SIGTERM and return the exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout_seconds)

    def kill(self) -> None:
        """Send SIGKILL, so that not even clean-up code runs."""
        self.process.kill()
        self.process.wait()


@contextmanager
def running_server(home: Path, environment: Mapping[str, str] | None = None) -> Generator[Server]:
    """Run `python -m accord.api.server` with a home folder until the block ends."""
    home.mkdir(parents=True, exist_ok=True)
    log = home / "server.log"
    with log.open("ab") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "accord.start", "accord.api.server"],
            env=os.environ
            | {"ACCORD_HOME": str(home), "ACCORD_PORT": "0", "OMP_NUM_THREADS": "1"}
            | dict(environment or {}),
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        url = _address(process, log)
        _until_answers(process, url, log)
        yield Server(process, url, log)
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        process.wait()


def _address(process: subprocess.Popen[bytes], log: Path) -> str:
    """The address that the server logs; it chooses the port itself."""
    deadline = time.monotonic() + PATIENCE_SECONDS
    while time.monotonic() < deadline:
        if found := re.search(rf"Process {process.pid} serves (http://[^\s\"]+)", log.read_text()):
            return found[1]
        if process.poll() is not None:
            break
        time.sleep(0.01)
    raise AssertionError(f"the server did not start:\n{log.read_text()}")


def _until_answers(process: subprocess.Popen[bytes], url: str, log: Path) -> None:
    deadline = time.monotonic() + PATIENCE_SECONDS
    while time.monotonic() < deadline and process.poll() is None:
        with suppress(httpx.TransportError):
            if httpx.get(f"{url}/api/v1/health", **PLAIN_HTTP).is_success:
                return
        time.sleep(0.01)
    raise AssertionError(f"the server does not respond:\n{log.read_text()}")
