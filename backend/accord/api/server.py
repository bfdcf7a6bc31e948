"""The process of the HTTP server: `python -m accord.api.server`.

Alone, it listens on ACCORD_HOST and ACCORD_PORT. `accord up` passes it a listening socket of its own (`--fd`), so that
requests wait while this process restarts.
"""

import argparse
import asyncio
import logging
import os
import signal
import socket
import sys
from functools import partial
from pathlib import Path
from types import FrameType
from typing import cast

import uvicorn
from fastapi import FastAPI

from accord import logs
from accord.api.app import create_app
from accord.api.connections import Connections, LimitedHttp
from accord.api.listener import address_of, listen, require_protection
from accord.domain.errors import AccordError
from accord.services.webhook_delivery import WebhookSender
from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database
from accord.store.home import keep_new_files_private
from accord.store.migrate import migrate
from mapt.processes import follow_parent

log = logging.getLogger(__name__)

#: time for open requests to finish at shutdown; live events end at once
GRACE_SECONDS = 5


def serve(listener: socket.socket, settings: Settings) -> None:
    """Serves on a listening socket until SIGINT or SIGTERM. First checks the database and the blob store.

    Raises:
        DatabaseTooNew, DatabaseUnreachable, BlobsNotWritable: the message says what to do.
    """
    database = Database.open(settings.resolved_database_url)
    try:
        migrate(database)
        blobs = open_blobs(settings.resolved_blob_url)
        blobs.check_writable()
        config = server_config(create_app(settings, database, blobs), settings)
        log.info("Process %d serves %s", os.getpid(), address_of(listener))
        sender = WebhookSender(database, private_addresses=settings.webhook_private_addresses)
        sender.start()
        try:
            uvicorn.Server(config).run([listener])
        finally:
            sender.close()
    finally:
        database.close()


def server_config(app: FastAPI, settings: Settings) -> uvicorn.Config:
    """How uvicorn serves the application."""
    return uvicorn.Config(
        app,
        http=cast(type[asyncio.Protocol], partial(LimitedHttp, connections=Connections(settings))),
        ws="none",
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=GRACE_SECONDS,
        proxy_headers=bool(settings.public_url),
        forwarded_allow_ips=settings.trusted_proxies,
    )


def end_by_exception(_signal: int, _frame: FrameType | None) -> None:
    """Signal handler: exits through every `finally`. uvicorn raises the signal again when it has shut down."""
    raise SystemExit(0)


def main() -> int:
    """Runs the server; returns the exit status of the process."""
    parser = argparse.ArgumentParser(prog="python -m accord.api.server", description=__doc__)
    parser.add_argument("--fd", type=int, help="descriptor of a listening socket to serve on")
    parser.add_argument("--parent", type=int, default=0, help="exit when the process with this id exits; 0 for none")
    parser.add_argument("--log", type=Path, help="file that standard output and error go to")
    arguments = parser.parse_args()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end_by_exception)
    follow_parent(arguments.parent)
    keep_new_files_private()
    settings = Settings()
    logs.configure(settings.log_format, "api", arguments.log)
    try:
        if arguments.fd is None:
            require_protection(settings)
        listener = listen(settings.host, settings.port) if arguments.fd is None else socket.socket(fileno=arguments.fd)
        with listener:
            serve(listener, settings)
    except AccordError as error:
        log.error("%s", error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
