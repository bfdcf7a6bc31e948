"""`accord up` as a process of its own, over a home folder and a port that stay the same when it is started again."""

import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import httpx
import psutil

from accord.domain.enums import Role
from accord.services import accounts
from accord.store.database import Database
from support.ports import free_port
from support.waiting import PATIENCE_SECONDS

#: few and short clips, few labels: the whole loop within a minute of a busy machine
SMALL: dict[str, Any] = {
    "task": "HalfCheetah-6x1",
    "total_steps": 40_000,
    "segment_steps": 20,
    "label_budget": 60,
    "initial_labels": 20,
    "labels_per_version": 20,
}


class Service:
    """The whole service: page, API and workers."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it and wait until it answers."""
        self.home.mkdir(parents=True, exist_ok=True)
        command = ["up", "--home", str(self.home), "--port", str(self.port), "--no-example"]
        with (self.home / "up.log").open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "accord.cli", *command], env=environment(), stdout=log, stderr=log
            )
        deadline = time.monotonic() + PATIENCE_SECONDS
        while time.monotonic() < deadline and self._process.poll() is None:
            with suppress(httpx.TransportError):
                if httpx.get(f"{self.url}/api/v1/health", trust_env=False).is_success:
                    return
            time.sleep(0.05)
        raise AssertionError(f"accord up did not start:\n{(self.home / 'up.log').read_text()}")

    def stop(self) -> None:
        """SIGTERM, as a person's Ctrl-C."""
        if self._process is not None and self.is_alive():
            self._process.send_signal(signal.SIGTERM)
            self._process.wait(PATIENCE_SECONDS)

    def is_alive(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def kill(self) -> None:
        """SIGKILL to every process of it, and wait until the port is nobody's."""
        assert self._process is not None
        parent = psutil.Process(self._process.pid)
        family = [parent, *parent.children(recursive=True)]
        for process in family:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        self._process.wait(PATIENCE_SECONDS)
        psutil.wait_procs(family, timeout=PATIENCE_SECONDS)

    def add_user(self, name: str, role: str) -> tuple[str, str]:
        """A new user's bearer token and sign-in link, as `accord user add` makes them."""
        database = Database.open(f"sqlite:///{self.home / 'accord.db'}")
        try:
            with database.transaction() as session:
                row, token = accounts.create_user(session, name, Role(role))
                link_token = accounts.make_link(session, row.id, minutes=60)
        finally:
            database.close()
        return token, f"{self.url}/sign-in/{link_token}"

    def api(self, token: str) -> httpx.Client:
        """A client of the REST API, as a researcher's script uses it."""
        headers = {"Authorization": f"Bearer {token}"}
        return httpx.Client(base_url=f"{self.url}/api/v1", headers=headers, trust_env=False, timeout=PATIENCE_SECONDS)

    def rows(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        """What the database holds, read past the API."""
        with closing(sqlite3.connect(self.home / "accord.db")) as connection:
            return connection.execute(statement, values).fetchall()


def environment() -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1", "ACCORD_TORCH_THREADS": "1"}
