"""Runs `accord up` as a separate process that can be stopped, killed and restarted on the same home and port."""

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
from support import short_tasks
from support.plain_http import PLAIN_HTTP
from support.ports import free_port
from support.waiting import PATIENCE_SECONDS

#: short episodes, few and short clips, and a small policy, which leave the cores to the browser
SMALL: dict[str, Any] = {
    "task": short_tasks.NAME,
    "total_steps": 40_000,
    "segment_steps": 20,
    "label_budget": 60,
    "initial_labels": 10,
    "labels_per_version": 20,
    "lookahead_queries": 4,
    "policy": {"n_envs": 16, "rollout_steps": 100, "epochs": 2, "minibatches": 2},
}


class Service:
    """The service with page, API and workers."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the service and wait until it responds."""
        self.home.mkdir(parents=True, exist_ok=True)
        command = ["up", "--home", str(self.home), "--port", str(self.port), "--no-example"]
        with (self.home / "up.log").open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "accord.cli", *command], env=environment(), stdout=log, stderr=log
            )
        deadline = time.monotonic() + PATIENCE_SECONDS
        with httpx.Client(**PLAIN_HTTP) as client:
            while time.monotonic() < deadline and self._process.poll() is None:
                with suppress(httpx.TransportError):
                    if client.get(f"{self.url}/api/v1/health").is_success:
                        return
                time.sleep(0.05)
        raise AssertionError(f"accord up did not start:\n{(self.home / 'up.log').read_text()}")

    def stop(self) -> None:
        """Stop the service with SIGTERM."""
        if self._process is not None and self.is_alive():
            self._process.send_signal(signal.SIGTERM)
            self._process.wait(PATIENCE_SECONDS)

    def is_alive(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def kill(self) -> None:
        """Send SIGKILL to all its processes and wait until they have ended."""
        assert self._process is not None
        parent = psutil.Process(self._process.pid)
        processes = [parent, *parent.children(recursive=True)]
        for process in processes:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        self._process.wait(PATIENCE_SECONDS)
        psutil.wait_procs(processes, timeout=PATIENCE_SECONDS)

    def link_for(self, user_id: str) -> str:
        """A new sign-in link for a user."""
        database = Database.open(f"sqlite:///{self.home / 'accord.db'}")
        try:
            with database.transaction() as session:
                return f"{self.url}/sign-in/{accounts.make_link(session, user_id, minutes=60)}"
        finally:
            database.close()

    def add_user(self, name: str, role: str) -> tuple[str, str]:
        """Add a user as `accord user add` does; return the bearer token and the sign-in link."""
        database = Database.open(f"sqlite:///{self.home / 'accord.db'}")
        try:
            with database.transaction() as session:
                row, token = accounts.create_user(session, name, Role(role))
                link_token = accounts.make_link(session, row.id, minutes=60)
        finally:
            database.close()
        return token, f"{self.url}/sign-in/{link_token}"

    def api(self, token: str) -> httpx.Client:
        """A client of the REST API with this bearer token."""
        headers = {"Authorization": f"Bearer {token}"}
        return httpx.Client(base_url=f"{self.url}/api/v1", headers=headers, timeout=PATIENCE_SECONDS, **PLAIN_HTTP)

    def named(self) -> set[str]:
        """The ids of all experiments and users."""
        return {id for (id,) in self.rows("select id from experiments union select id from users")}

    def free_names(self, kept: set[str]) -> None:
        """Rename all experiments and users but those with these ids: each gets its id as name."""
        with closing(sqlite3.connect(self.home / "accord.db", timeout=PATIENCE_SECONDS)) as connection, connection:
            for id in self.named() - kept:
                connection.execute("update experiments set name = id where id = ?", (id,))
                connection.execute("update users set name = id where id = ?", (id,))

    def rows(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        """Query the database directly, without the API."""
        with closing(sqlite3.connect(self.home / "accord.db")) as connection:
            return connection.execute(statement, values).fetchall()


def environment() -> dict[str, str]:
    """Small clips without anti-aliasing, which leave more of the cores to the browser."""
    settings = {
        "OMP_NUM_THREADS": "1",
        "ACCORD_TORCH_THREADS": "1",
        "ACCORD_CLIP_QUALITY": "fast",
        "ACCORD_CLIP_WIDTH": "320",
    }
    return os.environ | short_tasks.ENVIRONMENT | settings
