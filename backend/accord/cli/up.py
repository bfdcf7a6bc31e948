"""accord up: the service on this machine, one parent and its processes."""

import os
import socket
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from sqlalchemy.exc import SQLAlchemyError

from accord.api.server import listen
from accord.cli.options import Home, address_file, load_settings, url_of
from accord.cli.output import note, on_terminal, out, say
from accord.domain.enums import WorkerRole
from accord.domain.errors import AccordError, NameTaken, Unavailable
from accord.services import accounts, experiments, workers
from accord.services.experiment_config import ExperimentConfig
from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database
from accord.workers.runner import RETRY_TEXT, Stop
from accord.workers.supervisor import ChildSpec, Death, Supervisor
from mapt.processes import SHARED_CORES_ENVIRONMENT, follow_parent

#: how often the supervisor looks after its children
_TICK_SECONDS = 0.2
#: frames may come late, labels and updates should not
_RENDER_NICE = 5


@dataclass(frozen=True, slots=True)
class Ready:
    """What is needed to start the processes."""

    #: with the port that was really given
    settings: Settings
    database: Database
    #: listens already; the API's process inherits it
    listener: socket.socket


def up(
    *,
    home: Home = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.  [default: 127.0.0.1]")] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port to listen on; 0 takes a free one.  [default: 8000]")
    ] = None,
    example: Annotated[
        bool, typer.Option(help="Make an example experiment at the first start, so that there is something to label.")
    ] = True,
    parent: Annotated[int, typer.Option(hidden=True, help="Pid to end with; 0 for none.")] = 0,
) -> None:
    """Start the service: the page, the API and the workers. Ctrl-C ends it."""
    stop = Stop()
    stop.install()
    follow_parent(parent)
    ready = prepare(load_settings(home, host, port))
    try:
        announce(ready, example)
        _serve(ready, stop)
    finally:
        address_file(ready.settings).unlink(missing_ok=True)
        ready.listener.close()
        ready.database.close()


def announce(ready: Ready, example: bool) -> None:
    """Print where to go, and leave the address for the other commands."""
    if example:
        create_example(ready.database)
    link = sign_in_link(ready)
    address_file(ready.settings).write_text(url_of(ready.settings.host, ready.settings.port) + "\n")
    say("[bold]Accord[/bold] is starting. Open this link to sign in:")
    out.print(f"\n  {link}\n", markup=False)
    say("[dim]It works once; `accord link` prints a new one. Ctrl-C ends Accord.[/dim]")


def _serve(ready: Ready, stop: Stop) -> None:
    watch, specs = Watch(ready.database), child_specs(ready)
    watch.begin(specs)
    supervisor = Supervisor(specs, ready.settings.home / "logs", watch.died)
    status = out.status("starting", refresh_per_second=2) if on_terminal() else None
    try:
        if status:
            status.start()
        while not stop.wait(_TICK_SECONDS):
            supervisor.tick()
            line = watch.look()
            if status and line:
                status.update(escape(line))
    finally:
        if status:
            status.stop()
        note("accord", "stopping; Ctrl-C again kills what is left")
        killed = supervisor.shutdown(stop)
        note("accord", f"stopped; killed: {', '.join(killed)}" if killed else "stopped")


def child_specs(ready: Ready) -> list[ChildSpec]:
    """The API and the workers, as the settings ask for them."""
    settings, environment = ready.settings, environment_of(ready.settings)
    api = ChildSpec(
        "api",
        ("accord.cli.serve", "--fd", str(ready.listener.fileno())),
        environment=environment | {"OMP_NUM_THREADS": "1"},
        descriptors=(ready.listener.fileno(),),
    )
    counts = {"policy": settings.policy_workers, "reward": settings.reward_workers, "render": settings.render_workers}
    threads = {"policy": settings.torch_threads, "reward": settings.torch_threads, "render": 1}
    workers = [
        ChildSpec(
            f"{role}-{slot}",
            (f"accord.workers.{role}_worker", "--slot", str(slot)),
            role=role,
            environment=environment | SHARED_CORES_ENVIRONMENT | {"OMP_NUM_THREADS": str(threads[role])},
            nice=_RENDER_NICE if role == "render" else 0,
        )
        for role, count in counts.items()
        for slot in range(count)
    ]
    return [api, *workers]


def environment_of(settings: Settings) -> dict[str, str]:
    """The settings as variables, for a child to read back; folders absolute."""
    values = settings.model_dump() | {"home": settings.home.resolve()}
    return {f"ACCORD_{name.upper()}": str(Path(value) if name == "home" else value) for name, value in values.items()}


EXAMPLE_NAME = "Teach the cheetah to run"
#: first labels soon, so that a newcomer sees the policy change within minutes
EXAMPLE = ExperimentConfig(
    task="HalfCheetah-6x1",
    total_steps=1_000_000,
    label_budget=200,
    initial_labels=20,
    labels_per_version=20,
)


class HomeNotWritable(Unavailable):
    """The home folder cannot be made or written."""

    code = "home_not_writable"


def prepare(settings: Settings) -> Ready:
    """Check the home folder, the blobs and the port; bring the database up to date.

    Raises:
        HomeNotWritable, BlobsNotWritable, DatabaseTooNew, DatabaseUnreachable, PortInUse: a sentence with the fix.
    """
    make_home(settings)
    open_blobs(settings.resolved_blob_url).check_writable()
    listener = listen(settings.host, settings.port)
    database = Database.open(settings.resolved_database_url)
    try:
        database.migrate()
    except Exception:
        listener.close()
        raise
    return Ready(settings.model_copy(update={"port": listener.getsockname()[1]}), database, listener)


def make_home(settings: Settings) -> None:
    """Make the home folder and its logs.

    Raises:
        HomeNotWritable: if that cannot be done.
    """
    logs = settings.home / "logs"
    try:
        logs.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HomeNotWritable(
            f"The home folder {settings.home} cannot be made: {error.strerror}. Choose another with --home."
        ) from error
    if not os.access(logs, os.W_OK):
        raise HomeNotWritable(
            f"The home folder {settings.home} cannot be written. Give this user the right to, "
            "or choose another with --home."
        )


def sign_in_link(ready: Ready) -> str:
    """A one-time link that signs the admin in; the admin is made at the first start."""
    with ready.database.transaction() as session:
        admin = accounts.ensure_admin(session)
        token = accounts.make_link(session, admin.id, ready.settings.link_minutes)
    base = ready.settings.public_url.rstrip("/") or url_of(ready.settings.host, ready.settings.port)
    return f"{base}/sign-in/{token}"


def create_example(database: Database) -> bool:
    """Make the example experiment, unless it was made before. Returns whether it was made now."""
    try:
        with database.transaction() as session:
            admin = accounts.ensure_admin(session)
            experiments.create(session, admin.id, EXAMPLE_NAME, EXAMPLE, None)
    except NameTaken:
        return False
    return True


_LOOK_SECONDS = 1.0


class Watch:
    """Reads the workers' rows once a second, and says once what is new about a failure."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._said: dict[str, str] = {}
        self._next_look = 0.0

    def begin(self, specs: Iterable[ChildSpec]) -> None:
        """Count the restarts of these workers from 0."""
        with self._database.transaction() as session:
            for spec in specs:
                if spec.role:
                    workers.report(session, spec.name, WorkerRole(spec.role), 0, "starting", restarts=0)

    def died(self, death: Death) -> None:
        """Print a death and write it on the worker's row, where the page finds it."""
        note(death.name, death.description)
        self._said[death.name] = death.description
        if not death.role:
            return
        try:
            with self._database.transaction() as session:
                workers.report(
                    session,
                    death.name,
                    WorkerRole(death.role),
                    0,
                    "backing_off",
                    death.description,
                    restarts=death.restarts,
                )
        except (AccordError, SQLAlchemyError) as error:
            note("accord", f"The death of {death.name} could not be recorded: {error}")

    def look(self) -> str | None:
        """A line about all workers, once a second; None in between. Failures are printed when they are new."""
        if time.monotonic() < self._next_look:
            return None
        self._next_look = time.monotonic() + _LOOK_SECONDS
        try:
            with self._database.reading() as session:
                rows = [(row.id, row.state, row.detail) for row in workers.all(session)]
        except (AccordError, SQLAlchemyError) as error:
            return f"The database does not answer: {error}"
        for id, state, detail in rows:
            self._say_failure(id, state, detail)
        return " · ".join(f"{id}: {detail if state == 'working' and detail else state}" for id, state, detail in rows)

    def _say_failure(self, id: str, state: str, detail: str) -> None:
        if state == "working":
            self._said.pop(id, None)
        if state != "backing_off":
            return
        # The pause grows with every try; the failure is the same.
        failure = detail.partition(RETRY_TEXT)[0].strip()
        if failure and self._said.get(id) != failure:
            self._said[id] = failure
            note(id, failure)
