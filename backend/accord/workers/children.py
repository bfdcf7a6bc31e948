"""A child process: started in a group of its own, watched, ended with all it started."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

#: a log that has grown beyond this is put aside at the next start
_LOG_BYTES = 10_000_000


@dataclass(frozen=True, slots=True)
class ChildSpec:
    """How to start one process."""

    #: unique, and the name of its log: api, render-0, ...
    name: str
    #: what follows `python -m`; ` --parent <pid>` is appended
    arguments: tuple[str, ...]
    #: role of a worker; empty for the API, which has no row
    role: str = ""
    #: variables on top of the supervisor's own
    environment: Mapping[str, str] = field(default_factory=dict[str, str])
    #: file descriptors it inherits
    descriptors: tuple[int, ...] = ()
    #: added to its niceness: above 0, others come first
    nice: int = 0


class Child:
    """One process that runs, or did."""

    def __init__(self, spec: ChildSpec, log_folder: Path) -> None:
        """Start it. Its standard output and error go to `<name>.log`."""
        self.spec = spec
        self.log_path = log_folder / f"{spec.name}.log"
        _put_aside(self.log_path)
        with self.log_path.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", *spec.arguments, "--parent", str(os.getpid())],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, **spec.environment},
                pass_fds=spec.descriptors,
                # Its own session: Ctrl-C on the terminal reaches the supervisor alone, which ends the others in order.
                start_new_session=True,
            )
        if spec.nice:
            with contextlib.suppress(ProcessLookupError):
                os.setpriority(os.PRIO_PROCESS, self._process.pid, spec.nice)

    @property
    def pid(self) -> int:
        return self._process.pid

    def ended(self) -> str | None:
        """How it ended, in words; None while it runs."""
        status = self._process.poll()
        if status is None:
            return None
        return f"was ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"

    def terminate(self) -> None:
        """Ask it to end."""
        if self._process.poll() is None:
            self._process.terminate()

    def wait(self, seconds: float) -> bool:
        """Wait for its end, at most so long. Returns whether it has ended."""
        try:
            self._process.wait(max(0.0, seconds))
        except subprocess.TimeoutExpired:
            return False
        return True

    def kill_group(self) -> None:
        """Kill it and whatever it started that still runs."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def last_words(self) -> str:
        """The last line of its log, empty if there is none."""
        with self.log_path.open("rb") as log:
            log.seek(max(0, log.seek(0, os.SEEK_END) - 4096))
            lines = log.read().decode(errors="replace").strip().splitlines()
        return lines[-1].strip() if lines else ""


def _put_aside(path: Path) -> None:
    if path.exists() and path.stat().st_size > _LOG_BYTES:
        path.replace(path.with_suffix(".log.1"))
