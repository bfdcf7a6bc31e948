"""The status of a process."""

import psutil


def alive(pid: int) -> bool:
    """Whether the process is running. A zombie is not."""
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
