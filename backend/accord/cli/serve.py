"""The API's process: `python -m accord.cli.serve --fd N`, started by `accord up` with a socket that listens already.

The socket is the parent's, so a request that comes while this process is started again waits instead of failing.
"""

import argparse
import logging
import socket
import sys

import uvicorn

from accord.api.app import create_app
from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database
from accord.workers.lifeline import follow_parent

#: live events never end by themselves: at a stop they are cut after this long
_DRAIN_SECONDS = 2


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m accord.cli.serve", description=__doc__)
    parser.add_argument("--fd", type=int, required=True, help="descriptor of the listening socket")
    parser.add_argument("--parent", type=int, default=0, help="pid to end with; 0 for none")
    arguments = parser.parse_args()
    follow_parent(arguments.parent)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    settings = Settings()
    database = Database.open(settings.resolved_database_url)
    app = create_app(settings, database, open_blobs(settings.resolved_blob_url))
    config = uvicorn.Config(
        app, log_config=None, access_log=False, timeout_graceful_shutdown=_DRAIN_SECONDS, lifespan="on"
    )
    with socket.socket(fileno=arguments.fd) as listener:
        uvicorn.Server(config).run(sockets=[listener])
    database.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
