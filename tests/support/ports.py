"""Free ports for servers that cannot choose one themselves."""

import random
import socket
from contextlib import suppress


def free_port() -> int:
    """A free port outside the kernel's range for outgoing connections, so that no such connection occupies it."""
    for port in random.sample(range(20_000, 32_000), 100):
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError("no free port between 20000 and 32000")
