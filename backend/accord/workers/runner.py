"""The process of a worker: signals, the work loop with backoff, and the context that every worker gets."""

import argparse
import logging
import os
import random
import secrets
import select
import signal
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Protocol

from accord import logs
from accord.domain.enums import WorkerRole, WorkerState
from accord.domain.errors import AccordError
from accord.settings import Settings
from accord.store.blobs import BlobStore, open_blobs
from accord.store.database import Database
from accord.store.home import keep_new_files_private
from accord.workers.heartbeat import Heartbeat
from mapt.errors import MaptError
from mapt.processes import follow_parent

log = logging.getLogger(__name__)

#: follows the failure in the detail of a worker that backs off
RETRY_TEXT = "Retrying in"
_LONGEST_ERROR = 400


@dataclass(frozen=True, slots=True)
class Backoff:
    """Exponential backoff with jitter, so that workers that failed together do not retry together."""

    first_seconds: float = 0.5
    longest_seconds: float = 30.0

    def seconds(self, failures: int, rng: random.Random) -> float:
        """The pause after `failures` failures in a row (at least 1): between half of the step and the whole step."""
        step = min(self.longest_seconds, self.first_seconds * 2.0 ** min(failures - 1, 30))
        return step * rng.uniform(0.5, 1.0)


class Stop:
    """A request to end, from SIGTERM, SIGINT or a call; never withdrawn. Any thread may wait for it.

    Waiting uses a pipe. `threading.Event` takes a lock to set, and a signal handler that runs while the main thread
    holds that lock in `wait` would block for ever.
    """

    def __init__(self) -> None:
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        self._count = 0

    def install(self) -> None:
        """Handle SIGTERM and SIGINT of this process. Main thread only."""
        signal.signal(signal.SIGTERM, self._handle)
        signal.signal(signal.SIGINT, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.request()

    def request(self) -> None:
        """Ask to end. A second request asks to end at once."""
        self._count += 1
        if self._count == 1:
            os.write(self._write, b"x")

    @property
    def requested(self) -> bool:
        return self._count > 0

    @property
    def immediate(self) -> bool:
        """Whether there was more than one request."""
        return self._count > 1

    def wait(self, seconds: float) -> bool:
        """Wait for a request, at most `seconds`. Returns whether there was one."""
        if not self.requested:
            select.select([self._read], [], [], max(0.0, seconds))
        return self.requested

    def close(self) -> None:
        os.close(self._read)
        os.close(self._write)


@dataclass(frozen=True, slots=True)
class Context:
    """What every worker works with."""

    settings: Settings
    database: Database
    blobs: BlobStore
    heartbeat: Heartbeat
    stop: Stop
    #: names this process in its claims
    holder: str


class Worker(Protocol):
    """One role."""

    def work(self) -> bool:
        """Do one piece of work, if there is any. Returns whether there was.

        Level-triggered: the rows say what there is to do, so a poll that comes late finds the same work.
        """
        ...

    def close(self) -> None:
        """Release what would outlive the process. Takes at most a second or two."""
        ...


def work_until_stopped(
    worker: Worker,
    stop: Stop,
    poll_seconds: float,
    *,
    on_failure: Callable[[str], None],
    on_success: Callable[[bool], None],
) -> None:
    """Call `worker.work` until a stop is requested, with a pause when there is nothing to do or after a failure.

    Args:
        on_failure: called with a sentence after each failure.
        on_success: called after each call that did not fail, with its result.
    """
    backoff, rng = Backoff(), random.Random()
    failures = 0
    while not stop.requested:
        try:
            worked = worker.work()
        except Exception as error:
            failures += 1
            pause = backoff.seconds(failures, rng)
            log.error("Failure %d in a row; retrying in %.1f s", failures, pause, exc_info=error)
            on_failure(f"{error_sentence(error)} {RETRY_TEXT} {pause:.0f} s.")
            stop.wait(pause)
            continue
        failures = 0
        on_success(worked)
        if not worked:
            stop.wait(poll_seconds)


class BackgroundThread:
    """A thread of a worker's process that works until a stop is requested; its failures show in the worker's row."""

    def __init__(self, context: Context, worker: Worker, name: str, failing: str) -> None:
        """
        Args:
            failing: a sentence for the worker's row, before the failure: what does not happen now.
        """
        self._context, self._worker, self._failing = context, worker, failing
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def join(self, seconds: float) -> None:
        """Wait for the thread to end, after a stop was requested."""
        self._thread.join(seconds)

    def _run(self) -> None:
        heartbeat, name = self._context.heartbeat, self._thread.name
        work_until_stopped(
            self._worker,
            self._context.stop,
            self._context.settings.poll_seconds,
            on_failure=lambda failure: heartbeat.set_background_failure(name, f"{self._failing} {failure}"),
            on_success=lambda _: heartbeat.set_background_failure(name, ""),
        )


def run_loop(context: Context, worker: Worker) -> None:
    """Work until a stop is requested; the worker's row shows failures and idleness."""
    heartbeat = context.heartbeat
    work_until_stopped(
        worker,
        context.stop,
        context.settings.poll_seconds,
        on_failure=lambda failure: heartbeat.set_state(WorkerState.BACKING_OFF, failure),
        on_success=lambda worked: None if worked else heartbeat.set_state(WorkerState.IDLE),
    )


def run_worker(role: WorkerRole, make_worker: Callable[[Context], Worker], argv: Sequence[str]) -> int:
    """Run a worker's process from start to end. Returns its exit status.

    SIGTERM and SIGINT end it after its current step; long steps check `context.stop`.
    """
    arguments = _parser(role).parse_args(argv)
    stop = Stop()
    stop.install()
    follow_parent(arguments.parent)
    keep_new_files_private()
    settings = Settings()
    worker_id = settings.worker_id(f"{role.value}-{arguments.slot}")
    logs.configure(settings.log_format, worker_id, arguments.log)
    holder = f"{worker_id}:{os.getpid()}:{secrets.token_hex(4)}"
    database = Database.open(settings.resolved_database_url)
    heartbeat = Heartbeat(
        database, worker_id, role, holder, settings.worker_lease_seconds, hang_seconds=settings.worker_hang_seconds
    )
    heartbeat.start()
    context = Context(settings, database, open_blobs(settings.resolved_blob_url), heartbeat, stop, holder)
    log.info("%s started as %s", worker_id, holder)
    try:
        worker = make_worker(context)
        try:
            run_loop(context, worker)
        finally:
            worker.close()
    finally:
        heartbeat.close()
        database.close()
    log.info("%s stopped", worker_id)
    return 0


def error_sentence(error: BaseException) -> str:
    """An error as one sentence for people: its first line. The class name precedes errors of other libraries."""
    lines = str(error).strip().splitlines()
    text = lines[0] if lines else ""
    if not isinstance(error, AccordError | MaptError):
        text = f"{type(error).__name__}: {text}" if text else type(error).__name__
    if text and text[-1] not in ".!?":
        text += "."
    return text if len(text) <= _LONGEST_ERROR else text[: _LONGEST_ERROR - 1] + "…"


def _parser(role: WorkerRole) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m accord.workers.{role.value}_worker",
        description=f"The {role.value} worker. ACCORD_* environment variables configure it.",
    )
    parser.add_argument("--slot", type=int, default=0, help="number among the workers of this role")
    parser.add_argument("--parent", type=int, default=0, help="process id to end with; 0 for none")
    parser.add_argument("--log", type=Path, help="file that standard output and error go to")
    return parser
