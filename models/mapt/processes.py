"""Child processes: parallel jobs, processes that keep state, the division of cores, and requests to stop.

Imports neither torch nor anything else of this library, so that every package and command can use it.
"""

import ctypes
import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from multiprocessing.util import Finalize
from pathlib import Path
from types import FrameType
from typing import Any, Generic, TypeVar

#: Environment of processes that share cores with others. By default, OpenMP threads that wait for each other spin for
#: milliseconds. When other programs used the same cores (8 processes on 2 cores), a training with two spinning threads
#: took 127 s, with two sleeping threads 12 s. On idle cores, sleeping is slow: two sleeping threads train on 98
#: pairs/s, one thread on 104, two spinning threads on 167. With this setting, threads spin for tenths of a millisecond:
#: 148 pairs/s on idle cores, and 37 to 41 on shared cores, where sleeping threads reach 34 to 37.
SHARED_CORES_ENVIRONMENT = {"GOMP_SPINCOUNT": "10000"}

_WORKER_ENVIRONMENT = SHARED_CORES_ENVIRONMENT | {"OMP_NUM_THREADS": "1"}
# Forked processes cannot use CUDA, nor the torch threads of their parent.
_SPAWN = multiprocessing.get_context("spawn")
#: time that a process has to end before it is killed
_END_SECONDS = 10.0
#: time that a worker has from SIGTERM to its end, in which its parent may still use it
_GRACE_SECONDS = 30
#: interval at which `run_jobs` calls `should_stop`
_POLL_SECONDS = 0.2
_PR_SET_PDEATHSIG = 1

#: environment variable with the number of a worker among those that run side by side; see `worker_slot`
WORKER_SLOT_VARIABLE = "MAPT_WORKER_SLOT"

J = TypeVar("J")
R = TypeVar("R")


def parallel_jobs(requested: int, n_jobs: int) -> int:
    """Number of jobs to run in parallel, at most `n_jobs`; a request of 0 means one per core."""
    return max(1, min(requested or os.cpu_count() or 1, n_jobs))


def cores_per_job(n_parallel: int) -> int:
    """Cores for each of `n_parallel` jobs, at least 1."""
    return max(1, (os.cpu_count() or 1) // n_parallel)


def worker_slot() -> int:
    """Number of this worker process among those that run side by side, from 0; 0 in any other process."""
    return int(os.environ.get(WORKER_SLOT_VARIABLE, "0"))


@contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C and SIGTERM into a flag, so that work can end at a checkpoint. Main thread only.

    Yields:
        A function that returns whether a stop was requested. The second request raises KeyboardInterrupt.
    """
    requested = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal requested
        if requested:
            raise KeyboardInterrupt
        requested = True

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: requested
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def uncollected_imports() -> Iterator[None]:
    """Import modules in this block without garbage collection, and leave them out of later collections.

    For the start of a process: torch's modules create hundreds of thousands of objects and no garbage. Collections
    among their imports and at the end of the process took half of the CPU time of a worker that started and ended.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.freeze()


def follow_parent(parent_pid: int, *, grace_seconds: float = 8.0, check_seconds: float = 0.5) -> None:
    """End this process when its parent ends, even if the parent is killed: by SIGTERM, then by a hard exit.

    Linux signals the child at once. On other systems, and if the parent ended before this call, a thread notices that
    the parent's process id changed.

    Args:
        parent_pid: the process that started this one; 0 does nothing.
        grace_seconds: time from SIGTERM to the hard exit.
        check_seconds: interval at which the thread checks the parent.
    """
    if not parent_pid:
        return
    _signal_with_parent(signal.SIGTERM)
    threading.Thread(
        target=_watch_parent, args=(parent_pid, grace_seconds, check_seconds), name="parent-watch", daemon=True
    ).start()


def kill_with_parent(parent_pid: int) -> None:
    """Ask the kernel to kill this process at once when the thread that started it ends. Linux only.

    Raises:
        SystemExit: if the parent ended before this call.
    """
    _signal_with_parent(signal.SIGKILL)
    if os.getppid() != parent_pid:
        raise SystemExit("The parent process has ended.")


def _signal_with_parent(number: signal.Signals) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0)


def _watch_parent(parent_pid: int, grace_seconds: float, check_seconds: float) -> None:
    while os.getppid() == parent_pid:
        time.sleep(check_seconds)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(grace_seconds)
    os._exit(1)


def describe_exit(status: int | None) -> str:
    """Describe an exit status: "exit status 1", "killed by SIGKILL"."""
    if status is not None and status < 0:
        return f"killed by {signal.Signals(-status).name}"
    return f"exit status {status}"


def end_process(process: "subprocess.Popen[Any]", seconds: float) -> int:
    """Wait up to `seconds` for a process that was asked to end, then kill it. Returns its exit status."""
    try:
        return process.wait(max(0.0, seconds))
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


class ParentConnection:
    """The connection of a worker of `run_jobs` to its parent process."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def send(self, message: object) -> None:
        """Send the parent a picklable object. Does nothing if the parent has ended; see `cancelled`."""
        with suppress(BrokenPipeError, ConnectionResetError):
            self._connection.send(_Message(message))

    def cancelled(self) -> bool:
        """Whether the job should end, because the parent requests it or has ended."""
        # While a job runs, the parent sends nothing but this request. `poll` is also true for a closed connection.
        return self._connection.poll()


@dataclass(frozen=True, slots=True)
class JobResult(Generic[J, R]):
    """The outcome of a job."""

    job: J
    #: what the job function returned; None if it failed
    result: R | None
    #: why the job failed; None if it did not
    failure: str | None = None


@dataclass(frozen=True, slots=True)
class _Message:
    content: object


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a job function returned, or why it failed."""

    result: Any = None
    failure: str | None = None


@dataclass(slots=True)
class _Worker(Generic[J]):
    process: SpawnProcess
    connection: Connection
    job: J | None = None


def run_jobs(
    do_job: Callable[[J, ParentConnection], R],
    jobs: Sequence[J],
    n_workers: int,
    *,
    on_start: Callable[[J], None] = lambda job: None,
    on_message: Callable[[J, Any], None] = lambda job, message: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Iterator[JobResult[J, R]]:
    """Run jobs in order in `n_workers` single-threaded processes; yield each result when its job ends.

    A worker that dies fails its own job only, and is replaced. Workers end soon after their parent, even if it is
    killed.

    Args:
        do_job: a module-level function, or a partial of one. The function, jobs and results must be picklable.
        on_start: called with each job when it starts.
        on_message: called with the job and each object that it passes to `ParentConnection.send`.
        should_stop: once it returns true, no further job starts and the running jobs are asked to end; their results
            are still yielded.

    Raises:
        ValueError: if `n_workers` is below 1.
    """
    if n_workers < 1:
        raise ValueError(f"n_workers must be 1 or more, got {n_workers}.")
    waiting = list(reversed(jobs))
    workers: list[_Worker[J]] = [_start(do_job, slot) for slot in range(min(n_workers, len(jobs)))]
    try:
        stopping = False
        while True:
            if not stopping and should_stop():
                stopping = True
                for worker in workers:
                    _send(worker, None)
            for worker in workers:
                if worker.job is None and waiting and not stopping:
                    worker.job = waiting.pop()
                    on_start(worker.job)
                    _send(worker, worker.job)
            busy = [worker for worker in workers if worker.job is not None]
            if not busy:
                return
            ready = wait([worker.connection for worker in busy], _POLL_SECONDS)
            for worker in busy:
                if worker.connection not in ready or worker.job is None:
                    continue
                job, received = worker.job, _receive(worker)
                if isinstance(received, _Message):
                    on_message(job, received.content)
                    continue
                worker.job = None
                if not worker.process.is_alive() and waiting and not stopping:
                    slot = workers.index(worker)
                    workers[slot] = _start(do_job, slot)
                yield JobResult(job, received.result, received.failure)
    finally:
        _end(workers)


class JobProcess(Generic[J, R]):
    """A single-threaded process for jobs that one after the other change what their job function holds.

    It ends soon after this process, even if that is killed.

    Args:
        do_job: a picklable callable, of which the process has a copy. Jobs and results must be picklable, too, and a
            job must not be None.
    """

    def __init__(self, do_job: Callable[[J, ParentConnection], R]) -> None:
        self._worker: _Worker[J] = _start(do_job, worker_slot())

    def send(self, job: J) -> None:
        """Start a job. Returns at once."""
        self._worker.job = job
        _send(self._worker, job)

    def receive(self) -> JobResult[J, R]:
        """Wait for the result of the job that was sent."""
        job, received = self._worker.job, _receive(self._worker)
        if job is None or isinstance(received, _Message):
            raise RuntimeError("Send one job, which sends no messages, before each result.")
        self._worker.job = None
        return JobResult(job, received.result, received.failure)


def end_job_processes(processes: "Sequence[JobProcess[Any, Any]]") -> None:
    """End these processes. They end at the same time."""
    _end([process._worker for process in processes])


def _start(do_job: Callable[[J, ParentConnection], Any], slot: int) -> _Worker[J]:
    ours, theirs = _SPAWN.Pipe()
    process = _SPAWN.Process(target=_work, args=(theirs,), daemon=True)
    with _environment({**_WORKER_ENVIRONMENT, WORKER_SLOT_VARIABLE: str(slot)}):
        process.start()
    theirs.close()
    # Ends it when this process exits without having closed the connection.
    Finalize(process, ours.close, exitpriority=0)
    worker = _Worker[J](process, ours)
    _send(worker, do_job)
    return worker


def _end(workers: Sequence[_Worker[Any]]) -> None:
    """Ask all workers to end, and kill those that still run after `_END_SECONDS`."""
    for worker in workers:
        worker.connection.close()
    for worker in workers:
        worker.process.join(_END_SECONDS)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()


def _send(worker: _Worker[J], job: J | Callable[[J, ParentConnection], Any] | None) -> None:
    # If the worker died while idle, the next `wait` on its connection reports it.
    with suppress(BrokenPipeError, ConnectionResetError):
        worker.connection.send(job)


def _receive(worker: _Worker[Any]) -> _Message | Outcome:
    try:
        return worker.connection.recv()
    except (EOFError, ConnectionResetError):
        worker.process.join(_END_SECONDS)
        return Outcome(failure=f"its worker process died ({describe_exit(worker.process.exitcode)})")


@contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(connection: Connection) -> None:
    """The main function of a worker: receive the job function, then jobs, and send the outcome of each.

    None or a closed connection ends the process.
    """
    parent = ParentConnection(connection)
    # It was started as a daemon, so that it ends with its parent. Daemons may not start processes, which some tasks
    # need; these end with this one.
    multiprocessing.current_process().daemon = False
    # SIGTERM to a whole process group, such as a service manager's, reaches the parent as well. It ends its workers
    # in order, and may need their state or results until then.
    signal.signal(signal.SIGTERM, lambda *_: signal.alarm(_GRACE_SECONDS))
    # The parent may be gone when a job ends, and Ctrl-C reaches all processes of a terminal.
    with suppress(EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        with uncollected_imports():
            do_job = connection.recv()
        while (job := connection.recv()) is not None:
            connection.send(outcome_of(do_job, job, parent))


def outcome_of(do_job: Callable[[Any, ParentConnection], object], job: object, parent: ParentConnection) -> Outcome:
    """Do a job. An error that it raises becomes a sentence."""
    try:
        return Outcome(do_job(job, parent))
    except Exception as error:  # noqa: BLE001  (one job's failure must not end the others)
        return Outcome(failure=_describe_error(error))


def _describe_error(error: Exception) -> str:
    """The error in one line. Errors of other libraries include their type and their place in the code."""
    if type(error).__module__.startswith("mapt."):
        return str(error)
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(where.filename).name}, line {where.lineno})"
