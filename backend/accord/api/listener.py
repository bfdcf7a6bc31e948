"""The server's listening socket.

`accord up` opens it for the server's process, so this module does not import the web framework.
"""

import errno
import socket

from accord.domain.addresses import is_loopback
from accord.domain.errors import PlainHttpRefused, PortInUse, Unavailable
from accord.settings import Settings

_BACKLOG = 2048


def require_protection(settings: Settings) -> None:
    """Raises PlainHttpRefused if the server would listen beyond this machine without a proxy and without permission."""
    if not (is_loopback(settings.host) or settings.public_url or settings.allow_plain_http):
        raise PlainHttpRefused(settings.host)


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; with port 0 the system chooses a port, which `getsockname` returns.

    Raises:
        PortInUse: if another program listens there.
        Unavailable: if this machine does not have the address, or the user may not use the port.
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
            f"Cannot listen on {host}:{port} ({error.strerror}): this machine does not have the address, or this user "
            "may not use the port. Choose another with --host and --port."
        ) from error
    return listener


def address_of(listener: socket.socket) -> str:
    """The URL of a listening socket."""
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
