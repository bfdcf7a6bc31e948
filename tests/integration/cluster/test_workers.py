"""`accord up --ray` on a cluster with a node for each role, of which one is lost while the policy trains."""

import os
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import psutil
import pytest
from sqlalchemy import text

from acceptance.accord_service import STEPS_PER_ITERATION, Accord, Client
from accord.cli.worker_status import WorkerStatus
from accord.domain.enums import WorkerRole
from accord.settings import Settings
from accord.store.database import Database
from accord.store.migrate import migrate
from accord.workers.ray_supervisor import RaySupervisor
from accord.workers.runner import Stop
from accord.workers.supervisor import ChildSpec
from integration.cluster.conftest import NODE
from mapt.cluster import load_ray
from support.s3_server import S3Server
from support.store_fixtures import postgres_server, s3_server
from support.stores import PostgresServer, migrated_postgres_database
from support.waiting import until

__all__ = ["postgres_server", "s3_server"]

N_ITERATIONS = 40
#: labels of each reward version
VERSIONS = [8, 10, 12]
EXPERIMENT: dict[str, Any] = {
    "label_budget": VERSIONS[-1],
    "initial_labels": VERSIONS[0],
    "labels_per_version": 2,
    "lookahead_queries": 1,
    "total_steps": N_ITERATIONS * STEPS_PER_ITERATION,
}


@pytest.fixture
def database(
    postgres_server: PostgresServer, s3_server: S3Server, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Database]:
    """A database and a bucket that all nodes reach, which the environment names."""
    with migrated_postgres_database(postgres_server.url, "ray") as url, closing(Database.open(url)) as opened:
        monkeypatch.setenv("ACCORD_DATABASE_URL", url)
        monkeypatch.setenv("ACCORD_BLOB_URL", s3_server.url("ray"))
        yield opened


def rows(database: Database, statement: str, **values: object) -> list[tuple[Any, ...]]:
    with database.reading() as session:
        return [tuple(row) for row in session.execute(text(statement), values)]


def curve(database: Database, id: str) -> list[tuple[Any, ...]]:
    """Step, name and value of every metric but the speed."""
    statement = "SELECT step, name, value FROM metrics WHERE experiment_id = :id AND name <> 'steps_per_second'"
    return rows(database, f"{statement} ORDER BY step, name", id=id)


def iterations(database: Database, id: str) -> int:
    return len({step for step, name, _ in curve(database, id) if name == "learned_return"})


def versions(database: Database, id: str) -> list[int]:
    """Labels of each reward version."""
    statement = "SELECT label_count FROM reward_versions WHERE experiment_id = :id ORDER BY number"
    return [labels for (labels,) in rows(database, statement, id=id)]


def details_of_restarts(database: Database) -> list[str]:
    """What the page shows of the workers that start again."""
    return [detail for (detail,) in rows(database, "SELECT detail FROM workers WHERE state = 'restarting'")]


def label_when_due(database: Database, client: Client, id: str) -> dict[str, float]:
    """Label a pair if the policy waits for it and the next pair is there, so that timing does not decide the pairs.

    Returns:
        The label that the service acknowledged, if any.
    """
    statement = "SELECT status, count(*) FROM queries WHERE experiment_id = :id GROUP BY status"
    counts: dict[str, int] = dict(rows(database, statement, id=id))
    is_next_there = counts.get("open", 0) > 1 or sum(counts.values()) == VERSIONS[-1]
    waits = client.experiment(id)["waiting_for"] == "labels"
    return client.label_some(id, most=1) if waits and is_next_there else {}


def test_an_experiment_goes_on_when_the_node_of_its_policy_is_lost(
    cluster: Any, database: Database, tmp_path: Path
) -> None:
    nodes = {role.value: cluster.add_node(**NODE, resources={role.value: 1}) for role in WorkerRole}
    accord = Accord(tmp_path / "web", os.environ["ACCORD_DATABASE_URL"])
    try:
        settings = {"ACCORD_HOST_NAME": "lab", "ACCORD_RAY_RESOURCES": "true"}
        accord.start(settings, more=["--ray", cluster.address])
        client = Client(accord, accord.token("ada", "researcher"))
        curves: list[list[tuple[Any, ...]]] = []
        for name in ("undisturbed", "disturbed"):
            id = client.create_experiment(**EXPERIMENT, name=name)
            acknowledged: dict[str, float] = {}

            def second_version(id: str = id, acknowledged: dict[str, float] = acknowledged) -> bool:
                acknowledged.update(label_when_due(database, client, id))
                return len(versions(database, id)) >= 2

            def finished(id: str = id, acknowledged: dict[str, float] = acknowledged) -> bool:
                acknowledged.update(label_when_due(database, client, id))
                return client.experiment(id)["status"] == "finished"

            until(second_version, "the second reward version")
            if name == "disturbed":
                cluster.remove_node(nodes["policy"], allow_graceful=False)
                assert 1 <= iterations(database, id) < N_ITERATIONS
                nodes["policy"] = cluster.add_node(**NODE, resources={"policy": 1})
                # Until the new process has imported torch.
                [detail] = until(lambda: details_of_restarts(database), "the policy worker starts again")
                assert "Last line of its log: " in detail
            until(finished, "the experiment finishes")
            stored = rows(database, "SELECT query_id, value FROM labels WHERE experiment_id = :id", id=id)
            assert acknowledged == dict(stored)
            assert versions(database, id) == VERSIONS
            curves.append(curve(database, id))
        assert iterations(database, id) == N_ITERATIONS
        assert curves[0] == curves[1]
        workers = {worker["id"]: worker["restarts"] for worker in client.request("GET", "/workers")}
        assert workers == {"policy-0@lab": 1, "render-0@lab": 0, "reward-0@lab": 0}
        log = (tmp_path / "web" / "logs" / "policy-0.log").read_text()
        assert log.count(f"policy-0 starts on {socket.gethostname()}, node ") == 2
        running = [pid for (pid,) in rows(database, "SELECT pid FROM workers")]
        accord.kill_everything()
        until(lambda: not any(map(psutil.pid_exists, running)), "the actors of the killed supervisor end")
    finally:
        accord.kill_everything()
        for node in nodes.values():
            cluster.remove_node(node)


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(home=tmp_path)


@pytest.fixture
def status(settings: Settings) -> Iterator[WorkerStatus]:
    """Writes to a new database of SQLite."""
    with closing(Database.open(settings.resolved_database_url)) as opened:
        migrate(opened)
        yield WorkerStatus(settings, opened, lambda line, name: None)


def workers_of(settings: Settings) -> dict[str, tuple[str, str, int]]:
    """State, detail and restarts of each worker with a row."""
    with closing(Database.open(settings.resolved_database_url)) as opened:
        found = rows(opened, "SELECT id, state, detail, restarts FROM workers")
    return {id: (state, detail, restarts) for id, state, detail, restarts in found}


def worker_specs(module: str, settings: Settings) -> list[ChildSpec]:
    """Two render workers."""
    environment = {"ACCORD_HOME": str(settings.home)}
    return [
        ChildSpec(f"render-{slot}", (module, "--slot", str(slot)), role="render", environment=environment)
        for slot in range(2)
    ]


def test_a_failing_worker_restarts_and_one_that_is_not_due_does_not_start(
    cluster: Any, status: WorkerStatus, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loops fail at once, because there is no such module."""
    node = cluster.add_node(**NODE | {"num_cpus": 2})
    monkeypatch.setattr("accord.workers.ray_supervisor._SCALE_SECONDS", 0.0)
    due = {WorkerRole.RENDER: 1}
    specs = worker_specs("nowhere", settings)
    status.reset(specs)
    supervisor = RaySupervisor(cluster.address, specs, settings, settings.home, status, demand=lambda: due)

    def restarts(name: str) -> int:
        supervisor.tick()
        return workers_of(settings).get(name, ("", "", 0))[2]

    until(lambda: restarts("render-0") >= 2, "the first worker's second failure")
    assert "nowhere" in workers_of(settings)["render-0"][1]
    assert workers_of(settings).keys() == {"render-0"}
    due[WorkerRole.RENDER] = 7
    until(lambda: restarts("render-1"), "the second worker's failure")
    assert supervisor.shutdown(Stop()) == []
    logged = (settings.home / "render-0.log").read_text()
    assert logged.startswith(f"render-0 starts on {socket.gethostname()}, node {node.node_id[:8]}")
    assert logged.endswith("ModuleNotFoundError: No module named 'nowhere'\n")
    cluster.remove_node(node)


def test_rows_say_what_workers_wait_for_and_those_that_are_not_needed_have_none(
    cluster: Any, status: WorkerStatus, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    for interval in ("_SCALE_SECONDS", "_START_SECONDS", "_IDLE_SECONDS"):
        monkeypatch.setattr(f"accord.workers.ray_supervisor.{interval}", 0.0)
    due = {WorkerRole.RENDER: 2}
    specs = worker_specs("integration.cluster.waiting_worker", settings)
    supervisor = RaySupervisor(cluster.address, specs, settings, settings.home, status, demand=lambda: due)

    def have(state: str, restarts: int, *names: str) -> bool:
        supervisor.tick()
        found = workers_of(settings)
        return found.keys() == set(names) and all(
            (found[name][0], found[name][2]) == (state, restarts) for name in names
        )

    def starts(name: str) -> int:
        supervisor.tick()
        log = settings.home / f"{name}.log"
        return log.read_text().count(f"{name} starts on ") if log.exists() else 0

    until(lambda: have("starting", 0, "render-0", "render-1"), "two workers without a node")
    assert "CPU: 1" in workers_of(settings)["render-0"][1]
    due[WorkerRole.RENDER] = 1
    until(lambda: have("starting", 0, "render-0"), "one worker without a node")
    due[WorkerRole.RENDER] = 2
    node = cluster.add_node(**NODE | {"num_cpus": 2})
    until(lambda: starts("render-0") and starts("render-1"), "two workers")
    # Its next process knows nothing of what this one was told.
    load_ray().kill(supervisor._reports, no_restart=False)
    cluster.remove_node(node, allow_graceful=False)
    until(lambda: have("restarting", 0, "render-0", "render-1"), "two workers whose node has gone")
    assert "process or node died" in workers_of(settings)["render-0"][1]
    node = cluster.add_node(**NODE | {"num_cpus": 2})
    until(lambda: have("restarting", 1, "render-0", "render-1"), "two new processes")
    until(lambda: starts("render-0") == 2 and starts("render-1") == 2, "two new processes")
    due[WorkerRole.RENDER] = 1
    until(lambda: have("restarting", 1, "render-0"), "one worker")
    assert supervisor.shutdown(Stop()) == []
    cluster.remove_node(node)
