"""python -m accord.api.server: the HTTP service alone, as a process. `accord up` starts it beside the workers."""

import errno
import logging
import os
import signal
import socket
from types import FrameType

import uvicorn

from accord.api.app import create_app
from accord.domain.errors import AccordError, PortInUse, Unavailable
from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database

log = logging.getLogger(__name__)

#: open requests are given this long when the server is asked to end; live events end at once
GRACE_SECONDS = 5
_BACKLOG = 2048


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; with port 0 the system chooses one, which `getsockname` tells.

    Raises:
        PortInUse: if another program listens there.
        Unavailable: if the address is none of this machine's, or the port needs more rights.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(_BACKLOG)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise PortInUse(host, port) from error
        raise Unavailable(
            f"Cannot listen on {host}:{port} ({error.strerror}): it is no address of this machine, or not for this "
            "user. Choose another with --host and --port."
        ) from error
    return listener


def address_of(listener: socket.socket) -> str:
    """The URL at which a listening socket is reached."""
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def serve(settings: Settings) -> None:
    """Serves until SIGINT or SIGTERM.

    Raises:
        PortInUse, DatabaseTooNew, DatabaseUnreachable, BlobsNotWritable: each says how to mend it.
    """
    with listen(settings.host, settings.port) as listener:
        serve_on(listener, settings)


def serve_on(listener: socket.socket, settings: Settings) -> None:
    """Serves on a socket that listens already. Checks first that the database and the blobs can be used.

    Raises:
        DatabaseTooNew, DatabaseUnreachable, BlobsNotWritable: each says how to mend it.
    """
    database = Database.open(settings.resolved_database_url)
    try:
        database.migrate()
        blobs = open_blobs(settings.resolved_blob_url)
        blobs.check_writable()
        config = uvicorn.Config(
            create_app(settings, database, blobs),
            log_config=None,
            access_log=False,
            timeout_graceful_shutdown=GRACE_SECONDS,
            proxy_headers=bool(settings.public_url),
        )
        log.info("[%d] serves at %s", os.getpid(), address_of(listener))
        uvicorn.Server(config).run([listener])
    finally:
        database.close()


def end_by_exception(_signal: int, _frame: FrameType | None) -> None:
    """Ends the process by way of every `finally`: uvicorn, when done, raises the signal that stopped it once more."""
    raise SystemExit(0)


def main() -> int:
    """Returns the process's exit status."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end_by_exception)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    logging.getLogger("alembic").setLevel(logging.WARNING)
    try:
        serve(Settings())
    except AccordError as error:
        log.error("%s", error)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
