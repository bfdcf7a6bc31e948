"""Starts the processes of `accord up`, restarts those that die, and stops them together."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from accord.workers.runner import Backoff, Stop

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


#: a child that ran this long has recovered: its next death counts as the first
_RECOVERED_SECONDS = 30.0


@dataclass(frozen=True, slots=True)
class Death:
    """A child ended although nobody asked it to."""

    name: str
    role: str
    #: a sentence: how it ended, and when it is started again
    sentence: str
    #: how often it has been started again, this time counted
    restarts: int


@dataclass(frozen=True, slots=True)
class _Slot:
    """One child's place."""

    spec: ChildSpec
    child: Child | None = None
    started_at: float = 0.0
    #: deaths in a row
    failures: int = 0
    restarts: int = 0
    #: when to start it again, while there is no child
    due_at: float = 0.0


class Supervisor:
    """Keeps one process per spec running. Single-threaded: `tick` does all the watching."""

    def __init__(
        self,
        specs: Sequence[ChildSpec],
        log_folder: Path,
        on_death: Callable[[Death], None],
        *,
        backoff: Backoff | None = None,
        rng: random.Random | None = None,
    ) -> None:
        self._log_folder = log_folder
        self._on_death = on_death
        self._backoff = backoff or Backoff()
        self._rng = rng or random.Random()
        self._slots = [_Slot(spec) for spec in specs]

    def pids(self) -> dict[str, int]:
        """Process ids of the children that run, by name."""
        return {slot.spec.name: slot.child.pid for slot in self._slots if slot.child}

    def tick(self) -> None:
        """Start what is due, notice what died. Call it a few times a second."""
        now = time.monotonic()
        self._slots = [self._look_after(slot, now) for slot in self._slots]

    def _look_after(self, slot: _Slot, now: float) -> _Slot:
        if slot.child is None:
            if now < slot.due_at:
                return slot
            return replace(slot, child=Child(slot.spec, self._log_folder), started_at=now)
        ended = slot.child.ended()
        if ended is None:
            return slot
        return self._bury(slot, slot.child, ended, now)

    def _bury(self, slot: _Slot, child: Child, ended: str, now: float) -> _Slot:
        # What a killed worker had started, a render process for example, would go on without it.
        child.kill_group()
        failures = 1 if now - slot.started_at > _RECOVERED_SECONDS else slot.failures + 1
        pause = self._backoff.seconds(failures, self._rng)
        words = f"It {ended}; it starts again in {pause:.1f} s."
        if last := child.last_words():
            words += f" Its last words: {last}"
        self._on_death(Death(slot.spec.name, slot.spec.role, words, slot.restarts + 1))
        return replace(slot, child=None, failures=failures, restarts=slot.restarts + 1, due_at=now + pause)

    def shutdown(self, stop: Stop, grace_seconds: float = 8.0) -> list[str]:
        """End all children: ask, wait, and kill what is left. Asked twice to stop, kill at once.

        Returns:
            names of those that had to be killed.
        """
        children = [slot.child for slot in self._slots if slot.child]
        self._slots = [replace(slot, child=None, due_at=float("inf")) for slot in self._slots]
        for child in children:
            child.terminate()
        deadline = time.monotonic() + grace_seconds
        alive = children
        while alive and time.monotonic() < deadline and not stop.insisted:
            alive = [child for child in alive if not child.wait(0.05)]
        for child in children:
            child.kill_group()
        return [child.spec.name for child in alive]
