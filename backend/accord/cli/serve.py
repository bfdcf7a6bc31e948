"""The API process: `python -m accord.cli.serve --fd N`, started by `accord up` with a listening socket.

The parent owns the socket, so that requests wait while this process restarts.
"""

import argparse
import logging
import signal
import socket
import sys

from accord.api.server import end_by_exception, serve_on
from accord.settings import Settings
from mapt.processes import follow_parent


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m accord.cli.serve", description=__doc__)
    parser.add_argument("--fd", type=int, required=True, help="descriptor of the listening socket")
    parser.add_argument("--parent", type=int, default=0, help="exit when the process with this id exits; 0 for none")
    arguments = parser.parse_args()
    # uvicorn raises again the signal that stopped it; without a handler, the database would not be closed.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end_by_exception)
    follow_parent(arguments.parent)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    with socket.socket(fileno=arguments.fd) as listener:
        serve_on(listener, Settings())
    return 0


if __name__ == "__main__":
    sys.exit(main())
