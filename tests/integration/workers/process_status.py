"""Whether a process runs."""

import psutil


def alive(pid: int) -> bool:
    """Whether this process runs; one that nobody has waited for yet does not."""
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
