"""No process outlives the supervisor, even one that was killed with no chance to say goodbye."""

import ctypes
import os
import signal
import sys
import threading
import time

_PR_SET_PDEATHSIG = 1


def follow_parent(parent_pid: int, *, grace_seconds: float = 8.0, check_seconds: float = 0.5) -> None:
    """End this process when its parent does: SIGTERM to itself, then, after the grace, a hard exit.

    Linux tells the child at once. Elsewhere, and if the parent had gone before this was called, a thread that
    looks at the parent's pid finds out.

    Args:
        parent_pid: who started this process, as the parent knows it; 0 to follow nobody.
        grace_seconds: how long the process may take to end by itself.
        check_seconds: how often the thread looks.
    """
    if not parent_pid:
        return
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    threading.Thread(
        target=_watch, args=(parent_pid, grace_seconds, check_seconds), name="lifeline", daemon=True
    ).start()


def _watch(parent_pid: int, grace_seconds: float, check_seconds: float) -> None:
    while os.getppid() == parent_pid:
        time.sleep(check_seconds)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(grace_seconds)
    os._exit(1)
