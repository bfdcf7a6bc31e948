"""A request to end, from a signal to whoever waits or works."""

import os
import select
import signal
from types import FrameType


class Stop:
    """Set once, by SIGTERM, SIGINT or a call; never cleared.

    Waiting is done on a pipe. `threading.Event` takes a lock to set, and a signal handler that runs while the main
    thread holds that lock in `wait` would wait for it for ever.
    """

    def __init__(self) -> None:
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        self._count = 0

    def install(self) -> None:
        """Take SIGTERM and SIGINT of this process. Main thread only."""
        signal.signal(signal.SIGTERM, self._handle)
        signal.signal(signal.SIGINT, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.request()

    def request(self) -> None:
        """Ask to end. The second time means: at once."""
        self._count += 1
        if self._count == 1:
            os.write(self._write, b"x")

    @property
    def requested(self) -> bool:
        return self._count > 0

    @property
    def insisted(self) -> bool:
        """Whether it was asked for more than once."""
        return self._count > 1

    def wait(self, seconds: float) -> bool:
        """Wait until asked to end, at most so long. Returns whether it was."""
        if not self.requested:
            select.select([self._read], [], [], max(0.0, seconds))
        return self.requested

    def close(self) -> None:
        os.close(self._read)
        os.close(self._write)
