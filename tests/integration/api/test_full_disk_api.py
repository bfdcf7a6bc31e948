"""Labels on a disk that fills up: none that was acknowledged is missing, and labelling goes on once there is space."""

import os
import subprocess
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import Engine, event, select, text

from accord.domain.enums import Role
from accord.store.database import Database
from accord.store.tables import ExperimentRow, LabelRow
from support.api_in_thread import ApiServer, run_api_server
from support.sample_experiments import SampleExperiment, create_sample, user
from support.stores import Stores, open_stores
from support.waiting import PATIENCE_SECONDS

LABELLERS, POSTERS = 16, 3
SEGMENTS, QUERIES = 80, 3000
BATCH = 20
#: each thread goes on for so many refusals, so that it also writes while others are refused
REFUSALS = 10
#: for new pages of the database, and on the disk, which also holds the write-ahead log
DATABASE_BYTES, DISK_BYTES = 400_000, 3_000_000


class Threads:
    """Labellers and batch posters, and what the service acknowledged to them."""

    def __init__(self, api: ApiServer, sample: SampleExperiment) -> None:
        self._api, self._made = api, sample
        self._lock = threading.Lock()
        self._batches = [sample.query_ids[i : i + BATCH] for i in range(QUERIES // 2, QUERIES, BATCH)]
        with api.stores.database.transaction() as session:
            self._tokens = [user(session, f"labeller {i}", Role.LABELLER)[1] for i in range(LABELLERS)]
        #: query -> label in segment order
        self.acknowledged: dict[str, float] = {}
        #: status and code of every refusal
        self.refusals: list[tuple[int, str]] = []
        self.failures: list[BaseException] = []

    def run(self) -> None:
        """Labels until every thread was refused often enough."""
        work: list[Callable[[], None]] = [lambda token=token: self._label(token) for token in self._tokens]
        work += [self._post] * POSTERS
        threads = [threading.Thread(target=self._caught, args=(each,)) for each in work]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(PATIENCE_SECONDS)
            assert not thread.is_alive()
        if self.failures:
            raise self.failures[0]

    def _caught(self, work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:  # noqa: BLE001 (the test's own thread raises it)
            self.failures.append(error)

    def _label(self, token: str) -> None:
        refused = 0
        with self._api.client(token) as client:
            while refused < REFUSALS:
                response = client.post(f"/api/v1/experiments/{self._made.experiment.id}/queries/next")
                if self._refused(response):
                    refused += 1
                    continue
                [query] = response.json()["items"]
                response = client.put(f"/api/v1/queries/{query['id']}/label", json={"label": 1})
                if self._refused(response):
                    refused += 1
                else:
                    self._acknowledge(response.json())

    def _post(self) -> None:
        refused = 0
        with self._api.client(self._api.tokens[Role.TEACHER]) as client:
            while refused < REFUSALS:
                with self._lock:
                    # in turn, since a refused batch is to be sent again
                    batch = self._batches[0]
                    self._batches.append(self._batches.pop(0))
                body = {"labels": [{"query_id": id, "label": 0, "teacher": {"name": "x" * 500}} for id in batch]}
                response = client.post(f"/api/v1/experiments/{self._made.experiment.id}/labels", json=body)
                if self._refused(response):
                    refused += 1
                    continue
                for item in response.json()["items"]:
                    if item["ok"]:
                        self._acknowledge(item["label"])

    def _refused(self, response: httpx.Response) -> bool:
        if response.status_code in (200, 201):
            return False
        with self._lock:
            self.refusals.append((response.status_code, response.json()["error"]["code"]))
        return True

    def _acknowledge(self, label: dict[str, object]) -> None:
        with self._lock:
            self.acknowledged[str(label["query_id"])] = float(str(label["label"]))


def stored(database: Database) -> dict[str, float | None]:
    with database.reading() as session:
        rows = session.execute(select(LabelRow.query_id, LabelRow.value).where(LabelRow.state == "label"))
        return dict(rows.all())


def limit_pages(engine: Engine) -> Callable[[], None]:
    """Lets the database grow by DATABASE_BYTES and no more; what it returns lifts the limit."""
    with engine.connect() as connection:
        pages = connection.execute(text("PRAGMA page_count")).scalar_one()
        most = pages + DATABASE_BYTES // connection.execute(text("PRAGMA page_size")).scalar_one()

    def set_limit(connection: Any, _record: object, _proxy: object) -> None:
        connection.execute(f"PRAGMA max_page_count = {most}")

    def lift() -> None:
        nonlocal most
        most = 2**30

    event.listen(engine, "checkout", set_limit)
    return lift


@contextmanager
def small_disk(folder: Path) -> Generator[None]:
    """A file system of its own at `folder`."""
    if os.getuid() != 0:
        pytest.skip("only root may mount a small file system")
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=24m", "none", str(folder)], check=False, capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"no small file system can be mounted here: {mounted.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def label_until_full(made: Stores, home: Path, fill: Callable[[], Callable[[], None]]) -> None:
    """Fills up, checks what was acknowledged, makes space, and checks that labelling goes on.

    Args:
        fill: leaves little space for the database, and returns what gives it back.
    """
    with run_api_server(made, home) as api:
        an_experiment = create_sample(
            made.database,
            made.blobs,
            segments=SEGMENTS,
            queries=QUERIES,
            render_clips=False,
            label_budget=QUERIES,
        )
        threads = Threads(api, an_experiment)
        make_space = fill()
        threads.run()
        found = stored(made.database)
        lost = {id: label for id, label in threads.acknowledged.items() if found.get(id) != label}
        assert lost == {}
        assert set(threads.refusals) == {(507, "database_full")}
        # more than one label each, so that a failed group had members to lose
        assert len(threads.acknowledged) > 2 * LABELLERS

        make_space()
        offered = api.labeller.post(f"/api/v1/experiments/{an_experiment.experiment.id}/queries/next").json()
        query = offered["items"][0]["id"]
        assert api.labeller.put(f"/api/v1/queries/{query}/label", json={"label": 0.5}).status_code == 201
        found = stored(made.database)
        assert found[query] == 0.5
        with made.database.reading() as session:
            row = session.get_one(ExperimentRow, an_experiment.experiment.id)
            assert row.label_count == len(found)


def test_no_acknowledged_label_is_lost_when_the_database_may_not_grow(sqlite: Stores, tmp_path: Path) -> None:
    label_until_full(sqlite, tmp_path, lambda: limit_pages(sqlite.database.engine))


def test_no_acknowledged_label_is_lost_when_the_disk_fills(tmp_path: Path) -> None:
    disk, home = tmp_path / "disk", tmp_path / "home"
    disk.mkdir()
    home.mkdir()
    filler = disk / "filler"

    def fill() -> Callable[[], None]:
        space = os.statvfs(disk)
        filler.write_bytes(bytes(space.f_bavail * space.f_bsize - DISK_BYTES))
        return filler.unlink

    with small_disk(disk), open_stores(home, f"sqlite:///{disk / 'accord.db'}") as made:
        label_until_full(made, home, fill)
