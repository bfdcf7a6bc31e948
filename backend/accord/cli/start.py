"""What `accord up` makes sure of before it starts anything: each failure says how to mend it."""

import os
import socket
from dataclasses import dataclass

from accord.api.server import listen
from accord.cli.options import url_of
from accord.domain.errors import NameTaken, Unavailable
from accord.domain.experiment import ExperimentConfig
from accord.services import accounts, experiments
from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database

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


@dataclass(frozen=True, slots=True)
class Ready:
    """What is needed to start the processes."""

    #: with the port that was really given
    settings: Settings
    database: Database
    #: listens already; the API's process inherits it
    listener: socket.socket


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
