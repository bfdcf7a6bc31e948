"""Three hosts with homes and working folders of their own share PostgreSQL and S3: a server and two with workers."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from sqlalchemy import text

from acceptance.accord_service import ENVIRONMENT, STEPS_PER_ITERATION, Accord, Client
from accord.store.database import Database
from support.s3_server import S3Server
from support.stores import PostgresServer, migrated_postgres_database
from support.waiting import PATIENCE_SECONDS, until

pytestmark = pytest.mark.slow

BUDGET = 24
EXPERIMENT: dict[str, Any] = {"label_budget": BUDGET, "total_steps": 24 * STEPS_PER_ITERATION}


class WorkerHost:
    """A host that `accord workers` runs on."""

    def __init__(self, folder: Path, environment: dict[str, str], roles: list[str]) -> None:
        folder.mkdir()
        counts = {f"ACCORD_{role}_WORKERS": str(int(role in roles)) for role in ("POLICY", "REWARD", "RENDER")}
        self.log = folder / "workers.log"
        with self.log.open("wb") as log:
            self._supervisor = psutil.Popen(
                [sys.executable, "-m", "accord.cli", "workers", "--home", "home"],
                cwd=folder,
                env=os.environ | ENVIRONMENT | environment | counts | {"ACCORD_HOST_NAME": folder.name},
                stdout=log,
                stderr=log,
            )

    def kill(self) -> None:
        """Send SIGKILL to all of its processes at once, as when a host loses power."""
        if self._supervisor.is_running():
            for process in (*self._supervisor.children(recursive=True), self._supervisor):
                process.kill()
            self._supervisor.wait(PATIENCE_SECONDS)


@pytest.fixture
def stores(postgres_server: PostgresServer, s3_server: S3Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[Database]:
    """A database and a bucket, which the environment names."""
    with migrated_postgres_database(postgres_server.url, "hosts") as url, closing(Database.open(url)) as database:
        monkeypatch.setenv("ACCORD_DATABASE_URL", url)
        monkeypatch.setenv("ACCORD_BLOB_URL", s3_server.url("hosts"))
        yield database


def rows(database: Database, statement: str, **values: object) -> list[tuple[Any, ...]]:
    with database.reading() as session:
        return [tuple(row) for row in session.execute(text(statement), values)]


def policy_host(database: Database) -> str:
    """The host that trains the policy; empty if there is none."""
    found = rows(database, "SELECT holder FROM claims WHERE subject LIKE 'policy:%' AND expires_at > now()")
    return found[0][0].partition("@")[2].partition(":")[0] if found else ""


def test_an_experiment_goes_on_without_a_killed_host_and_after_outages(
    tmp_path: Path, stores: Database, postgres_server: PostgresServer, s3_server: S3Server
) -> None:
    accord = Accord(tmp_path / "web", os.environ["ACCORD_DATABASE_URL"])
    hosts: list[WorkerHost] = []
    try:
        accord.start({"ACCORD_HOST_NAME": "web"}, without=["policy", "reward", "render", "child"])
        token = accord.token("ada", "researcher")
        client = Client(accord, token)
        id = client.create_experiment(**EXPERIMENT)
        acknowledged: dict[str, float] = {}

        def label_until(count: int) -> None:
            def enough() -> bool:
                acknowledged.update(client.label_some(id))
                return len(acknowledged) >= count

            until(enough, f"{count} labels")

        hosts.append(WorkerHost(tmp_path / "one", {}, ["POLICY", "RENDER"]))
        until(lambda: policy_host(stores) == "one", "the first host trains the policy")
        hosts.append(WorkerHost(tmp_path / "two", {}, ["POLICY", "REWARD", "RENDER"]))
        label_until(8)
        assert_outages_are_ridden_out(accord, token, stores, postgres_server, s3_server)
        label_until(12)

        until(lambda: policy_host(stores) == "one", "the first host trains the policy")
        hosts[0].kill()
        killed_at = time.monotonic()
        until(lambda: policy_host(stores) == "two", "the second host takes over")
        print(f"taken over {time.monotonic() - killed_at:.1f} s after the kill, with leases of 3 s")
        label_until(BUDGET)
        until(lambda: client.experiment(id)["status"] == "finished", "the experiment finishes")

        stored = rows(stores, "SELECT query_id, value FROM labels WHERE experiment_id = :id", id=id)
        assert acknowledged.items() <= dict(stored).items()
        workers = {worker["id"]: worker for worker in client.request("GET", "/workers")}
        assert set(workers) == {"policy-0@one", "render-0@one", "policy-0@two", "reward-0@two", "render-0@two"}
        assert workers["policy-0@one"]["heartbeat_age_seconds"] > workers["policy-0@two"]["heartbeat_age_seconds"]
        verified = accord.run("verify")
        assert verified.returncode == 0, verified.stdout
    finally:
        accord.kill_everything()
        for host in hosts:
            host.kill()


def assert_outages_are_ridden_out(
    accord: Accord, token: str, database: Database, postgres_server: PostgresServer, s3_server: S3Server
) -> None:
    """While a store is away, clients are told to try again; what does not need it works."""

    def get(path: str) -> httpx.Response:
        return accord.http.get(f"{accord.url}/api/v1{path}", headers={"Authorization": f"Bearer {token}"})

    [(clip,), *_] = rows(database, "SELECT id FROM clips WHERE status = 'ready'")
    s3_server.stop()
    assert_try_again(get(f"/clips/{clip}.mp4"), "blobs_unreachable")
    assert get("/experiments").is_success
    s3_server.start()
    until(lambda: get(f"/clips/{clip}.mp4").is_success, "clips are served again")

    postgres_server.stop()
    assert_try_again(get("/experiments"), "database_unreachable")
    assert get("/health").is_success
    postgres_server.start()
    until(lambda: get("/experiments").is_success, "experiments are served again")


def assert_try_again(response: httpx.Response, code: str) -> None:
    assert (response.status_code, response.json()["error"]["code"]) == (503, code)
    assert int(response.headers["Retry-After"]) > 0


def test_workers_of_another_host_need_shared_stores(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "accord.cli", "workers", "--home", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_SECONDS,
    )
    assert done.returncode == 2
    assert "ACCORD_DATABASE_URL" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
