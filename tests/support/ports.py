"""Ports for servers that cannot be asked for any free one."""

import random
import socket
from contextlib import suppress


def free_port() -> int:
    """Below the range from which the kernel gives ports to outgoing connections: nobody is given it meanwhile."""
    for port in random.sample(range(20_000, 32_000), 100):
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError("no free port between 20000 and 32000")
