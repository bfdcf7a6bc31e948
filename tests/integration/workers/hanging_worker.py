"""A worker process whose main thread blocks for ever once the file ACCORD_HOME/hang exists."""

import sys
import threading
from pathlib import Path

from accord.domain.enums import WorkerRole
from accord.workers.runner import Context, run_worker


class HangingWorker:
    """Idles, then waits for a lock that nobody releases."""

    def __init__(self, context: Context) -> None:
        self._file: Path = context.settings.home / "hang"

    def work(self) -> bool:
        if self._file.exists():
            lock = threading.Lock()
            lock.acquire()
            lock.acquire()
        return False

    def close(self) -> None:
        pass


if __name__ == "__main__":
    sys.exit(run_worker(WorkerRole.RENDER, HangingWorker, sys.argv[1:]))
