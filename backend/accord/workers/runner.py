"""The process of a worker: signals, the work loop with backoff, and the link to the parent process."""

import argparse
import ctypes
import logging
import os
import random
import secrets
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Protocol

from accord.domain.enums import WorkerRole
from accord.domain.errors import AccordError
from accord.settings import Settings
from accord.store.blobs import BlobStore, open_blobs
from accord.store.database import Database
from accord.workers.heartbeat import Pulse


@dataclass(frozen=True, slots=True)
class Backoff:
    """Doubling pauses with jitter, so that what failed together is not tried again together."""

    first_seconds: float = 0.5
    longest_seconds: float = 30.0

    def seconds(self, failures: int, rng: random.Random) -> float:
        """The pause after so many failures in a row, at least 1: between a half and the whole of the step."""
        step = min(self.longest_seconds, self.first_seconds * 2.0 ** min(failures - 1, 30))
        return step * rng.uniform(0.5, 1.0)


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


_LONGEST = 400


def sentence(error: BaseException) -> str:
    """The first line of what went wrong; the kind of error too, unless it is one of ours."""
    lines = str(error).strip().splitlines()
    words = lines[0] if lines else ""
    if not isinstance(error, AccordError):
        words = f"{type(error).__name__}: {words}" if words else type(error).__name__
    if words and words[-1] not in ".!?":
        words += "."
    return words if len(words) <= _LONGEST else words[: _LONGEST - 1] + "…"


log = logging.getLogger(__name__)

#: what follows the failure in a worker's detail
RETRY_WORDS = "Tries again in"


@dataclass(frozen=True, slots=True)
class Context:
    """What a worker works with."""

    settings: Settings
    database: Database
    blobs: BlobStore
    pulse: Pulse
    stop: Stop
    #: unique to this process
    holder: str


class Worker(Protocol):
    """One role."""

    def work(self) -> bool:
        """Do one piece of work if there is any. Returns whether there was.

        Level-triggered: it looks at the rows, not at a message, so a poll that comes late finds the same work.
        """
        ...

    def close(self) -> None:
        """Free what a process's end would not, in a second or two."""
        ...


def run_loop(context: Context, worker: Worker, backoff: Backoff, rng: random.Random) -> None:
    """Work until asked to end. A failure is recorded on the worker's row and in the log, then tried again later."""
    failures = 0
    while not context.stop.requested:
        try:
            worked = worker.work()
        except Exception as error:
            failures += 1
            pause = backoff.seconds(failures, rng)
            log.error("Failure %d in a row; next try in %.1f s", failures, pause, exc_info=error)
            context.pulse.say("backing_off", f"{sentence(error)} {RETRY_WORDS} {pause:.0f} s.")
            context.stop.wait(pause)
            continue
        failures = 0
        if not worked:
            context.pulse.say("idle")
            context.stop.wait(context.settings.poll_seconds)


def run_worker(role: WorkerRole, make_worker: Callable[[Context], Worker], argv: Sequence[str]) -> int:
    """A worker's process from start to end. Returns its exit status.

    SIGTERM and SIGINT end it after the step it is at: a long one asks `context.stop` now and then.
    """
    arguments = _parser(role).parse_args(argv)
    stop = Stop()
    stop.install()
    follow_parent(arguments.parent)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    settings = Settings()
    worker_id = f"{role.value}-{arguments.slot}"
    holder = f"{worker_id}:{os.getpid()}:{secrets.token_hex(4)}"
    database = Database.open(settings.resolved_database_url)
    pulse = Pulse(database, worker_id, role, holder, settings.worker_lease_seconds)
    pulse.start()
    context = Context(settings, database, open_blobs(settings.resolved_blob_url), pulse, stop, holder)
    log.info("%s started as %s", worker_id, holder)
    try:
        worker = make_worker(context)
        try:
            run_loop(context, worker, Backoff(), random.Random())
        finally:
            worker.close()
    finally:
        pulse.close()
        database.close()
    log.info("%s stopped", worker_id)
    return 0


def _parser(role: WorkerRole) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m accord.workers.{role.value}_worker",
        description=f"The {role.value} worker. Its settings are ACCORD_* variables.",
    )
    parser.add_argument("--slot", type=int, default=0, help="number among the workers of this role")
    parser.add_argument("--parent", type=int, default=0, help="pid to end with; 0 for none")
    return parser
