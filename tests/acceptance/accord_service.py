"""Runs `accord up` for the acceptance tests, which call its REST API and kill its processes."""

import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Collection, Mapping, Sequence
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
from support.waiting import PATIENCE_SECONDS, until

#: short episodes, small clips, frequent polling and short leases
ENVIRONMENT = short_tasks.ENVIRONMENT | {
    "ACCORD_CLIP_QUALITY": "fast",
    "ACCORD_CLIP_WIDTH": "128",
    "OMP_NUM_THREADS": "1",
    "ACCORD_TORCH_THREADS": "1",
    "ACCORD_POLL_SECONDS": "0.05",
    # after this, other workers take over a killed worker's work
    "ACCORD_WORKER_LEASE_SECONDS": "3",
}
TINY_POLICY = {"n_envs": 4, "rollout_steps": 50, "epochs": 2, "minibatches": 2}
STEPS_PER_ITERATION = 200
TINY: dict[str, Any] = {
    "task": short_tasks.NAME,
    "segment_steps": 10,
    "total_steps": 40 * STEPS_PER_ITERATION,
    "label_budget": 40,
    "initial_labels": 8,
    "labels_per_version": 8,
    "policy": TINY_POLICY,
}


class Accord:
    """A service over one home folder. It can be started, stopped and killed repeatedly."""

    def __init__(self, home: Path, database_url: str = "") -> None:
        """
        Args:
            database_url: of a migrated database; SQLite in the home folder by default.
        """
        self.home = home
        self._database_url = database_url or f"sqlite:///{home / 'accord.db'}"
        self.log = home.parent / "up.log"
        self.http = httpx.Client(timeout=60.0, **PLAIN_HTTP)
        self._supervisor: psutil.Popen | None = None
        self._absent: set[str] = set()
        self._seen: dict[int, psutil.Process] = {}

    def start(
        self,
        environment: Mapping[str, str] | None = None,
        without: Collection[str] = (),
        port: int = 0,
        more: Sequence[str] = (),
    ) -> None:
        """Start the service and wait until the API responds.

        Args:
            port: 0 for a free one.
            more: further arguments of `accord up`.
            without: roles for which no worker starts, because each costs seconds of CPU time.
        """
        self._absent = set(without)
        no_workers = {f"ACCORD_{role.upper()}_WORKERS": "0" for role in without}
        (self.home / "url").unlink(missing_ok=True)
        command = [sys.executable, "-m", "accord.cli", "up", "--home", str(self.home), "--no-example"]
        command += ["--port", str(port), *more]
        with self.log.open("ab") as log:
            self._supervisor = psutil.Popen(
                command, env=os.environ | ENVIRONMENT | no_workers | dict(environment or {}), stdout=log, stderr=log
            )
        until(self._responds, "the API responds")

    def _responds(self) -> bool:
        assert self.supervisor.is_running(), self.log.read_text()
        assert self.supervisor.status() != psutil.STATUS_ZOMBIE, self.log.read_text()
        with suppress(httpx.TransportError, FileNotFoundError):
            return self.http.get(f"{self.url}/api/v1/health").is_success
        return False

    @property
    def supervisor(self) -> psutil.Popen:
        assert self._supervisor is not None
        return self._supervisor

    @property
    def url(self) -> str:
        return (self.home / "url").read_text().strip()

    def logs(self) -> list[Path]:
        """The logs of the API and of the workers."""
        return sorted((self.home / "logs").glob("*.log"))

    def processes(self) -> dict[str, psutil.Process]:
        """The service's processes by role: api, policy, reward, render, and child, the render process."""
        running: dict[str, psutil.Process] = {}
        with suppress(psutil.NoSuchProcess):
            for process in self.supervisor.children(recursive=True):
                with suppress(psutil.NoSuchProcess):
                    arguments = process.cmdline()
                    for module, role in _ROLES.items():
                        if module in arguments and alive(process):
                            running[role] = process
                            self._seen[process.pid] = process
        return running

    def all_running(self) -> dict[str, psutil.Process] | None:
        """All processes, once there is one of each role that was not started without workers; else None."""
        running = self.processes()
        return running if running.keys() >= set(_ROLES.values()) - self._absent else None

    def all_ready(self) -> dict[str, psutil.Process] | None:
        """All processes, once every worker has finished its imports and handles signals; else None."""
        running = self.all_running()
        if not running or not ("child" in self._absent or ignores_interrupts(running["child"])):
            return None
        states = [state for (state,) in self.rows("SELECT state FROM workers")]
        return running if len(states) == 3 - len(self._absent) and "starting" not in states else None

    def send_signal(self, number: signal.Signals = signal.SIGTERM) -> None:
        self.supervisor.send_signal(number)

    def kill_everything(self) -> None:
        """Send SIGKILL to each running process, and close the client."""
        self.http.close()
        if self._supervisor is None:
            return
        self.processes()
        for process in (self._supervisor, *self._seen.values()):
            with suppress(psutil.NoSuchProcess):
                process.kill()
        with suppress(subprocess.TimeoutExpired, psutil.TimeoutExpired):
            self._supervisor.wait(PATIENCE_SECONDS)

    def run(self, *arguments: str, environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
        """Run another command with the same home folder."""
        command = [sys.executable, "-m", "accord.cli", *arguments, "--home", str(self.home)]
        variables = os.environ | ENVIRONMENT | dict(environment or {})
        return subprocess.run(
            command, env=variables, capture_output=True, text=True, check=False, timeout=PATIENCE_SECONDS
        )

    def token(self, name: str, role: str) -> str:
        """Add a user, as `accord user add` does; return their API token."""
        database = Database.open(self._database_url)
        try:
            with database.transaction() as session:
                return accounts.create_user(session, name, Role(role))[1]
        finally:
            database.close()

    def rows(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        """Rows of the database, read directly."""
        with closing(sqlite3.connect(self.home / "accord.db", timeout=20)) as connection:
            return connection.execute(statement, values).fetchall()


_ROLES = {
    "accord.api.server": "api",
    "accord.workers.policy_worker": "policy",
    "accord.workers.reward_worker": "reward",
    "accord.workers.render_worker": "render",
    "accord.rendering.child": "child",
}


def alive(process: psutil.Process) -> bool:
    """Whether the process is running. A zombie is not."""
    with suppress(psutil.NoSuchProcess):
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    return False


def ignores_interrupts(process: psutil.Process) -> bool:
    """Whether the process ignores SIGINT: the render process does so once the kernel would kill it with its parent."""
    with suppress(OSError):
        status = Path(f"/proc/{process.pid}/status").read_text()
        ignored = int(status.partition("SigIgn:")[2].split()[0], 16)
        return bool(ignored & 1 << signal.SIGINT - 1)
    return False


class Client:
    """A client of the REST API that retries while the service restarts, as the page does."""

    def __init__(self, accord: Accord, token: str) -> None:
        self._accord = accord
        self.headers = {"Authorization": f"Bearer {token}"}

    def request(self, method: str, path: str, body: Any = None, **query: Any) -> Any:
        """Send a request until the service responds; return the JSON of a successful response."""

        def attempt() -> httpx.Response | None:
            with suppress(httpx.TransportError, FileNotFoundError):
                url = f"{self._accord.url}/api/v1{path}"
                response = self._accord.http.request(method, url, json=body, params=query, headers=self.headers)
                return None if response.status_code == 503 else response
            return None

        response = until(attempt, f"a response to {method} {path}")
        assert response.is_success, f"{method} {path}: {response.status_code} {response.text}"
        return response.json()

    def create_experiment(self, **changes: Any) -> str:
        """Create a tiny experiment; return its id."""
        return self.request("POST", "/experiments", {"name": "tiny", **TINY, **changes})["id"]

    def experiment(self, id: str) -> dict[str, Any]:
        return self.request("GET", f"/experiments/{id}")

    def label_some(self, id: str, most: int = 4) -> dict[str, float]:
        """Label at most `most` open queries by true return. Return the labels that the service acknowledged."""
        queries = self.request("POST", f"/experiments/{id}/queries/next", count=most, returns=True)["items"]
        labels = {query["id"]: _oracle_label(query) for query in queries}
        if not labels:
            return {}
        batch = [{"query_id": query_id, "label": label} for query_id, label in labels.items()]
        outcomes = self.request("POST", f"/experiments/{id}/labels", {"labels": batch})["items"]
        return {outcome["query_id"]: labels[outcome["query_id"]] for outcome in outcomes if outcome["ok"]}


def _oracle_label(query: dict[str, Any]) -> float:
    first, second = sorted((query["left"], query["right"]), key=lambda side: side["index"])
    return 1.0 if first["true_return"] > second["true_return"] else 0.0
