"""Child processes: jobs in parallel, sharing of cores, requests to stop."""

import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import FrameType
from typing import Any, Generic, TypeVar

import torch

#: For processes whose OpenMP threads should be good neighbours. By default they spin for milliseconds while they
#: wait for each other: where other programs use the same cores, that made a training of two threads ten times slower
#: (127 s beside 12 s with sleeping threads, 8 processes on 2 cores). Threads that sleep at once are slow where cores
#: are idle: two train on 98 pairs a second, one on 104, two that spin on 167. These spin for tenths of a millisecond
#: (148), and lose nothing beside other programs (37 to 41; asleep 34 to 37).
PATIENT_THREADS = {"GOMP_SPINCOUNT": "10000"}


def at_once(asked: int, n_jobs: int) -> int:
    """How many of some jobs are done at once where `asked` are asked for: 0 is for one per core."""
    return max(1, min(asked or os.cpu_count() or 1, n_jobs))


def cores_of_each(n_at_once: int) -> int:
    """Threads that step the task of each of so many jobs."""
    return max(1, (os.cpu_count() or 1) // n_at_once)


@contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Gives a function that tells whether a stop was asked for; the second request interrupts. Main thread only."""
    asked = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


_ENVIRONMENT = PATIENT_THREADS | {"OMP_NUM_THREADS": "1"}
# Forked processes cannot use CUDA, nor the threads of torch that their parent had.
_SPAWN = multiprocessing.get_context("spawn")
_END_SECONDS = 10.0
#: how soon workers hear of a wish to stop
_POLL_SECONDS = 0.2

J = TypeVar("J")
R = TypeVar("R")


class Desk:
    """Where a worker does a job: its line to the parent."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def tell(self, news: object) -> None:
        """Give the parent something that can be pickled."""
        # A parent that is gone needs no news; `unwanted` says so.
        with suppress(BrokenPipeError, ConnectionResetError):
            self._connection.send(_News(news))

    def unwanted(self) -> bool:
        """Whether the job should end: the parent asks for it, or is gone."""
        # Nothing but that comes while a job is in hand, and the end of the line counts as something.
        return self._connection.poll()


@dataclass(frozen=True, slots=True)
class Done(Generic[J, R]):
    """What became of a job."""

    job: J
    #: what the work gave; None if it failed
    result: R | None
    #: why it failed; None where it did not
    failure: str | None = None


@dataclass(frozen=True, slots=True)
class _News:
    news: object


@dataclass(frozen=True, slots=True)
class _Outcome:
    result: Any = None
    failure: str | None = None


@dataclass(slots=True)
class _Worker(Generic[J]):
    process: SpawnProcess
    connection: Connection
    job: J | None = None


def run_jobs(
    work: Callable[[J, Desk], R],
    jobs: Sequence[J],
    n_workers: int,
    *,
    started: Callable[[J], None] = lambda job: None,
    told: Callable[[J, Any], None] = lambda job, news: None,
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[Done[J, R]]:
    """Do `jobs`, in that order, `n_workers` at once; yields each as it is done.

    A worker that dies fails its own job alone; another takes its place.

    Args:
        work: a function of a module, or a partial of one; it, the jobs and the results can be pickled.
        started: called when a worker takes a job.
        told: called with what `Desk.tell` was given.
        stopped: when it comes true, no further job begins and those in hand are asked to end; they are yielded too.

    Raises:
        ValueError: if nobody would do them.
    """
    if n_workers < 1:
        raise ValueError(f"n_workers must be 1 or more, got {n_workers}.")
    waiting = list(reversed(jobs))
    workers: list[_Worker[J]] = [_start(work) for _ in range(min(n_workers, len(jobs)))]
    try:
        asked = False
        while True:
            if not asked and stopped():
                asked = True
                for worker in workers:
                    _send(worker, None)
            for worker in workers:
                if worker.job is None and waiting and not asked:
                    worker.job = waiting.pop()
                    started(worker.job)
                    _send(worker, worker.job)
            busy = [worker for worker in workers if worker.job is not None]
            if not busy:
                return
            ready = wait([worker.connection for worker in busy], _POLL_SECONDS)
            for worker in busy:
                if worker.connection not in ready or worker.job is None:
                    continue
                job, message = worker.job, _receive(worker)
                if isinstance(message, _News):
                    told(job, message.news)
                    continue
                worker.job = None
                if not worker.process.is_alive() and waiting and not asked:
                    workers[workers.index(worker)] = _start(work)
                yield Done(job, message.result, message.failure)
    finally:
        _end(workers)


def _start(work: Callable[[J, Desk], Any]) -> _Worker[J]:
    ours, theirs = _SPAWN.Pipe()
    process = _SPAWN.Process(target=_work, args=(theirs, work), daemon=True)
    with _environment():
        process.start()
    theirs.close()
    return _Worker(process, ours)


def _end(workers: Sequence[_Worker[Any]]) -> None:
    """Who is still busy is killed if it does not end its job in time."""
    for worker in workers:
        worker.connection.close()
    for worker in workers:
        worker.process.join(_END_SECONDS)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()


def _send(worker: _Worker[J], job: J | None) -> None:
    # If it died while idle, what `wait` finds at its end of the pipe says so.
    with suppress(BrokenPipeError, ConnectionResetError):
        worker.connection.send(job)


def _receive(worker: _Worker[Any]) -> _News | _Outcome:
    try:
        return worker.connection.recv()
    except (EOFError, ConnectionResetError):
        worker.process.join(_END_SECONDS)
        return _Outcome(failure=f"its worker process died (exit status {worker.process.exitcode})")


@contextmanager
def _environment() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(connection: Connection, work: Callable[[Any, Desk], object]) -> None:
    """The life of a worker: jobs in, news and outcomes out; None, or the end of the line, ends it."""
    torch.set_num_threads(1)
    desk = Desk(connection)
    # The parent may be gone before it hears of a job's end, and Ctrl-C is for all processes of a terminal.
    with suppress(EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        while (job := connection.recv()) is not None:
            connection.send(_outcome(work, job, desk))


def _outcome(work: Callable[[Any, Desk], object], job: object, desk: Desk) -> _Outcome:
    try:
        return _Outcome(work(job, desk))
    except Exception as error:  # noqa: BLE001  (one job's failure must not take the others with it)
        return _Outcome(failure=_sentence(error))


def _sentence(error: Exception) -> str:
    """What went wrong; where, too, unless it is an error of this library, which says all that helps."""
    if type(error).__module__.startswith("mapt."):
        return str(error)
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(where.filename).name}, line {where.lineno})"
