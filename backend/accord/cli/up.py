"""The subcommand `accord up`: a parent process that keeps the API and the workers running."""

import os
import socket
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

import typer
from rich.markup import escape
from sqlalchemy.exc import SQLAlchemyError

from accord.api.listener import listen
from accord.cli.options import Home, Port, address_file, load_settings, url_of
from accord.domain.enums import WorkerRole, WorkerState
from accord.domain.errors import AccordError, NameTaken, Unavailable
from accord.services import accounts, experiments, workers
from accord.services.experiment_config import ExperimentConfig
from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database
from accord.store.migrate import migrate
from accord.workers.runner import RETRY_TEXT, Stop
from accord.workers.supervisor import ChildSpec, Death, Supervisor
from mapt.cli.output import log_line, on_terminal, out, print_line
from mapt.io import atomic_write
from mapt.processes import SHARED_CORES_ENVIRONMENT, follow_parent

#: Time between two checks of the child processes.
_TICK_SECONDS = 0.2
#: Rendering may be late; labels and policy updates should not.
_RENDER_NICE = 5


@dataclass(frozen=True, slots=True)
class Ready:
    """The settings, database and socket that the processes are started with."""

    #: with the actual port
    settings: Settings
    database: Database
    #: listening; the API's process inherits it
    listener: socket.socket


def up(
    *,
    home: Home = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.  [default: 127.0.0.1]")] = None,
    port: Port = None,
    example: Annotated[bool, typer.Option(help="Create an example experiment at the first start.")] = True,
    parent: Annotated[int, typer.Option(hidden=True, help="Exit when the process with this id exits; 0 for none.")] = 0,
) -> None:
    """Start the service: web page, API and workers.

    Prints a link that signs the admin in. Ctrl-C stops the service; a second Ctrl-C stops it at once.
    """
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
    """Print the sign-in link, and write the address to a file for the other commands."""
    if example:
        create_example(ready.database)
    link = sign_in_link(ready)
    url = url_of(ready.settings.host, ready.settings.port)
    # Atomic, because other commands wait for this file and read it as soon as it exists.
    atomic_write(address_file(ready.settings), f"{url}\n".encode())
    print_line("[bold]Accord[/bold] is starting. Open this link to sign in as the admin:")
    out.print(f"\n  {link}\n", markup=False)
    print_line("[dim]The link works once; `accord link` prints a new one. Ctrl-C stops Accord.[/dim]")


def _serve(ready: Ready, stop: Stop) -> None:
    status, specs = WorkerStatus(ready.database), child_specs(ready)
    status.reset(specs)
    supervisor = Supervisor(specs, ready.settings.home / "logs", status.record_death)
    spinner = out.status("starting", refresh_per_second=2) if on_terminal() else None
    try:
        if spinner:
            spinner.start()
        while not stop.wait(_TICK_SECONDS):
            supervisor.tick()
            line = status.poll()
            if spinner and line:
                spinner.update(escape(line))
    finally:
        if spinner:
            spinner.stop()
        log_line("stopping; press Ctrl-C again to kill the remaining processes", "accord")
        killed = supervisor.shutdown(stop)
        log_line(f"stopped; killed: {', '.join(killed)}" if killed else "stopped", "accord")


def child_specs(ready: Ready) -> list[ChildSpec]:
    """The processes of the API and of the workers."""
    settings, environment = ready.settings, environment_of(ready.settings)
    api = ChildSpec(
        "api",
        ("accord.api.server", "--fd", str(ready.listener.fileno())),
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
    """The settings as environment variables for a child process; the home folder is absolute."""
    values = settings.model_dump() | {"home": settings.home.resolve()}
    return {f"ACCORD_{name.upper()}": str(value) for name, value in values.items()}


EXAMPLE_NAME = "Teach the cheetah to run"
#: Few initial labels, so that a new user sees the policy change within minutes.
EXAMPLE = ExperimentConfig(
    task="HalfCheetah-6x1",
    total_steps=1_000_000,
    label_budget=200,
    initial_labels=20,
    labels_per_version=20,
)


class HomeNotWritable(Unavailable):
    """The home folder cannot be created or written."""

    code = "home_not_writable"


def prepare(settings: Settings) -> Ready:
    """Check the home folder, the blobs and the port, and migrate the database.

    Raises:
        HomeNotWritable, BlobsNotWritable, DatabaseTooNew, DatabaseUnreachable, PortInUse: with what to do about it.
    """
    make_home(settings)
    open_blobs(settings.resolved_blob_url).check_writable()
    listener = listen(settings.host, settings.port)
    database = Database.open(settings.resolved_database_url)
    try:
        migrate(database)
    except Exception:
        listener.close()
        raise
    return Ready(settings.model_copy(update={"port": listener.getsockname()[1]}), database, listener)


def make_home(settings: Settings) -> None:
    """Create the home folder and its folder of logs.

    Raises:
        HomeNotWritable: if that fails.
    """
    logs = settings.home / "logs"
    try:
        logs.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HomeNotWritable(
            f"The home folder {settings.home} cannot be created: {error.strerror}. Use another --home."
        ) from error
    if not os.access(logs, os.W_OK):
        raise HomeNotWritable(
            f"The home folder {settings.home} is not writable by this user. "
            "Change its permissions, or use another --home."
        )


def sign_in_link(ready: Ready) -> str:
    """A one-time link that signs the admin in; the admin is created at the first start."""
    with ready.database.transaction() as session:
        admin = accounts.ensure_admin(session)
        token = accounts.make_link(session, admin.id, ready.settings.link_minutes)
    base = ready.settings.public_url.rstrip("/") or url_of(ready.settings.host, ready.settings.port)
    return f"{base}/sign-in/{token}"


def create_example(database: Database) -> bool:
    """Create the example experiment unless it exists. Returns whether it was created."""
    try:
        with database.transaction() as session:
            admin = accounts.ensure_admin(session)
            experiments.create(session, admin.id, EXAMPLE_NAME, EXAMPLE, None)
    except NameTaken:
        return False
    return True


_POLL_SECONDS = 1.0
#: states in which the detail says more than the state's name
_SHOWN_BY_DETAIL = frozenset({WorkerState.WORKING, WorkerState.WAITING})


class WorkerStatus:
    """Reads the workers' rows once a second, and prints each failure once."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._printed: dict[str, str] = {}
        self._next_poll = 0.0

    def reset(self, specs: Iterable[ChildSpec]) -> None:
        """Set the number of restarts of these workers to 0."""
        with self._database.transaction() as session:
            for spec in specs:
                if spec.role:
                    workers.report(session, spec.name, WorkerRole(spec.role), 0, WorkerState.STARTING, restarts=0)

    def record_death(self, death: Death) -> None:
        """Print that a process died, and write it to the worker's row, which the page shows."""
        log_line(death.description, death.name)
        self._printed.pop(death.name, None)
        if not death.role:
            return
        try:
            with self._database.transaction() as session:
                workers.report(
                    session,
                    death.name,
                    WorkerRole(death.role),
                    0,
                    WorkerState.RESTARTING,
                    death.description,
                    restarts=death.restarts,
                )
        except (AccordError, SQLAlchemyError) as error:
            log_line(f"The restart of {death.name} could not be recorded: {error}", "accord")

    def poll(self) -> str | None:
        """One line about all workers, once a second; None in between. Prints new failures."""
        if time.monotonic() < self._next_poll:
            return None
        self._next_poll = time.monotonic() + _POLL_SECONDS
        try:
            with self._database.reading() as session:
                rows = [(row.id, row.state, row.detail) for row in workers.all(session)]
        except (AccordError, SQLAlchemyError) as error:
            return f"The database is unreachable: {error}"
        for id, state, detail in rows:
            self._print_failure(id, state, detail)
        return " · ".join(
            f"{id}: {detail if state in _SHOWN_BY_DETAIL and detail else state.replace('_', ' ')}"
            for id, state, detail in rows
        )

    def _print_failure(self, id: str, state: str, detail: str) -> None:
        if state == WorkerState.WORKING:
            self._printed.pop(id, None)
        if state != WorkerState.BACKING_OFF:
            return
        # Without the time of the next attempt, repeated failures are equal.
        failure = detail.partition(RETRY_TEXT)[0].strip()
        if failure and self._printed.get(id) != failure:
            self._printed[id] = failure
            log_line(failure, id)
