"""The server process: acknowledged labels survive SIGKILL, it stops cleanly, and it explains why it cannot start."""

import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import httpx
import pytest
from sqlalchemy import select, text

from accord.api.listener import address_of, listen
from accord.domain.enums import Role
from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database
from accord.store.migrate import migrate
from accord.store.tables import LabelRow
from support.api_in_thread import client
from support.api_process import running_server
from support.plain_http import PLAIN_HTTP
from support.sample_experiments import create_sample, user
from support.waiting import PATIENCE_SECONDS


def start_and_fail(home: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a server that is expected to exit with an error."""
    return subprocess.run(
        [sys.executable, "-m", "accord.start", "accord.api.server"],
        env=os.environ | {"ACCORD_HOME": str(home), "ACCORD_PORT": "0"} | environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_SECONDS,
        check=False,
    )


@pytest.mark.parametrize(
    "kill_after", [pytest.param(1, marks=pytest.mark.slow), 40, pytest.param(120, marks=pytest.mark.slow)]
)
def test_acknowledged_labels_survive_sigkill(tmp_path: Path, kill_after: int) -> None:
    settings = Settings(home=tmp_path)
    database, blobs = Database.open(settings.resolved_database_url), open_blobs(settings.resolved_blob_url)
    migrate(database)
    sample = create_sample(database, blobs, segments=21, queries=200, label_budget=200, initial_labels=200)
    with database.transaction() as session:
        tokens = [user(session, f"labeller {number}")[1] for number in range(4)]
    acknowledged: dict[str, float] = {}
    enough = threading.Event()

    def label(url: str, token: str) -> None:
        with client(url, token) as labeller:
            try:
                while True:
                    found = labeller.post(f"/api/v1/experiments/{sample.experiment.id}/queries/next").json()["items"]
                    response = labeller.put(
                        f"/api/v1/queries/{found[0]['id']}/label", json={"label": 1, "order": "shown"}
                    )
                    if response.status_code == 201:
                        acknowledged[found[0]["id"]] = response.json()["label"]
                    if len(acknowledged) >= kill_after:
                        enough.set()
            except httpx.TransportError:
                return

    with running_server(tmp_path) as server:
        threads = [threading.Thread(target=label, args=(server.url, token)) for token in tokens]
        for thread in threads:
            thread.start()
        assert enough.wait(PATIENCE_SECONDS)
        server.kill()
        for thread in threads:
            thread.join()
    with database.reading() as session:
        stored = {row.query_id: row.value for row in session.scalars(select(LabelRow))}
        count = session.execute(text("SELECT label_count FROM experiments")).scalar_one()
    assert len(acknowledged) >= kill_after
    assert acknowledged.items() <= stored.items()
    assert count == len(stored)
    database.close()
    # The next server reads the same labels.
    with running_server(tmp_path) as server, client(server.url, sample.owner_token) as researcher:
        labels = researcher.get(f"/api/v1/experiments/{sample.experiment.id}").json()["labels"]
        assert labels["labels"] == len(stored)


@pytest.mark.slow
def test_server_exits_cleanly_on_sigterm(tmp_path: Path) -> None:
    with running_server(tmp_path) as server:
        assert server.stop() == 0
    assert "Traceback" not in server.log.read_text()


def test_error_for_a_port_in_use_suggests_another(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        refused = start_and_fail(tmp_path, ACCORD_PORT=str(port))
    assert refused.returncode == 1
    assert f"127.0.0.1:{port} is in use" in refused.stderr
    assert f"--port {port + 1}" in refused.stderr
    assert "Traceback" not in refused.stderr


@pytest.mark.slow
def test_error_for_an_address_of_another_machine_explains_it(tmp_path: Path) -> None:
    assert "--allow-plain-http" in start_and_fail(tmp_path, ACCORD_HOST="no.such.host.invalid").stderr
    refused = start_and_fail(tmp_path, ACCORD_HOST="no.such.host.invalid", ACCORD_ALLOW_PLAIN_HTTP="true")
    assert refused.returncode == 1
    assert "does not have the address" in refused.stderr


@pytest.mark.slow
def test_error_for_a_newer_database_names_its_version(tmp_path: Path) -> None:
    database = Database.open(Settings(home=tmp_path).resolved_database_url)
    migrate(database)
    with database.transaction() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    database.close()
    refused = start_and_fail(tmp_path)
    assert refused.returncode == 1
    assert "'9999'" in refused.stderr
    assert "Traceback" not in refused.stderr


def test_error_for_a_blob_store_that_is_not_writable_names_it(tmp_path: Path) -> None:
    (tmp_path / "blobs").write_text("a file where the folder should be")
    refused = start_and_fail(tmp_path)
    assert refused.returncode == 1
    assert "blobs" in refused.stderr
    assert "Traceback" not in refused.stderr


@pytest.mark.slow
def test_unknown_role_is_refused(tmp_path: Path) -> None:
    with running_server(tmp_path) as server:
        settings = Settings(home=tmp_path)
        database = Database.open(settings.resolved_database_url)
        with database.transaction() as session:
            _, token = user(session, "root", Role.ADMIN)
        database.close()
        with client(server.url, token) as admin:
            response = admin.post("/api/v1/users", json={"name": "x", "role": "king"})
            assert response.status_code == 422
            assert "labeller" in response.json()["error"]["message"]


@pytest.mark.slow
def test_server_of_accord_up_closes_its_database_on_sigterm(tmp_path: Path) -> None:
    with listen("127.0.0.1", 0) as listener:
        process = subprocess.Popen(
            [sys.executable, "-m", "accord.start", "accord.api.server", "--fd", str(listener.fileno())],
            env=os.environ | {"ACCORD_HOME": str(tmp_path)},
            pass_fds=[listener.fileno()],
        )
        try:
            assert httpx.get(f"{address_of(listener)}/api/v1/health", timeout=PATIENCE_SECONDS, **PLAIN_HTTP).is_success
            process.terminate()
            assert process.wait(PATIENCE_SECONDS) == 0
        finally:
            process.kill()
            process.wait()
    # SQLite removes the write-ahead log when the last connection closes.
    assert not (tmp_path / "accord.db-wal").exists()
