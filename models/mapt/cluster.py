"""Jobs as tasks of a Ray cluster, and the choice between them and processes of this machine.

Ray is the extra `ray`; nothing loads it before a cluster is used. Tasks write to the same folders as processes do, so
every node needs the output folder under the same path. A task whose process or node dies runs again, and resumes from
what its folder holds.
"""

import logging
import os
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from mapt.errors import InvalidConfig
from mapt.processes import (
    SHARED_CORES_ENVIRONMENT,
    JobResult,
    Outcome,
    ParentConnection,
    cores_per_job,
    outcome_of,
    parallel_jobs,
    run_jobs,
)
from mapt.tasks.registry import TASK_FILES_VARIABLE

#: address of a cluster that is started on this machine and ends with the command
LOCAL = "local"
#: how often a job starts again after its process or its node died
MAX_RETRIES = 5
#: object store of a local cluster: jobs pass messages, their results are files
_LOCAL_STORE_BYTES = 100_000_000
#: interval at which the driver reads messages, and at which a job asks whether it should end
_POLL_SECONDS = 0.2

J = TypeVar("J")
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class RayCluster:
    """A Ray cluster, and what a job takes of it."""

    #: `auto`, HOST:PORT, or `local`
    address: str
    #: on a file system that all nodes share
    folder: Path
    job_cpus: int = 1
    job_gpus: float = 0.0


@dataclass(frozen=True, slots=True)
class JobPool:
    """Where the jobs of a command run: in processes of this machine, or on a cluster."""

    #: jobs at a time; 0: one per core of this machine, or as many as the cluster has room for
    workers: int = 0
    cluster: RayCluster | None = None

    def parallel(self, n_jobs: int) -> int:
        """Most jobs at a time."""
        if self.cluster is not None:
            return max(1, min(self.workers or n_jobs, n_jobs))
        return parallel_jobs(self.workers, n_jobs)

    def parallel_text(self, n_jobs: int) -> str:
        """How many jobs run at a time, for people."""
        count = f"{self.parallel(n_jobs)} in parallel"
        return count if self.cluster is None else f"at most {count}, as far as the cluster has room"

    def cores_per_job(self, n_jobs: int) -> int:
        """Cores for each of `n_jobs` jobs."""
        return self.cluster.job_cpus if self.cluster is not None else cores_per_job(self.parallel(n_jobs))

    def path(self, path: Path) -> Path:
        """The path as jobs need it: on a cluster, absolute."""
        return path.resolve() if self.cluster is not None else path

    def run(
        self,
        do_job: Callable[[J, ParentConnection], R],
        jobs: Sequence[J],
        *,
        on_start: Callable[[J], None] = lambda job: None,
        on_message: Callable[[J, Any], None] = lambda job, message: None,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> Iterator[JobResult[J, R]]:
        """Run jobs as `run_jobs` does. On a cluster, a job whose process or node dies runs again.

        Raises:
            InvalidConfig: if Ray is not installed, or no cluster answers.
        """
        n_workers = self.parallel(len(jobs))
        if self.cluster is None:
            return run_jobs(do_job, jobs, n_workers, on_start=on_start, on_message=on_message, should_stop=should_stop)
        return _run_tasks(
            self.cluster, do_job, jobs, n_workers, on_start=on_start, on_message=on_message, should_stop=should_stop
        )


def load_ray() -> Any:
    """The package `ray`.

    Raises:
        InvalidConfig: if it is not installed.
    """
    # Read when ray is imported.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        return import_module("ray")
    except ImportError as error:
        raise InvalidConfig(f"A Ray cluster needs a package: pip install 'accord[ray]' ({error}).", "ray") from error


def connect(address: str, needs: Mapping[str, float]) -> Any:
    """Connect this process to a cluster, unless it is connected. Returns the package `ray`.

    Args:
        address: see `RayCluster`.
        needs: what will run there at the same time, by the names of Ray's resources. A local cluster has room for it,
            also with fewer cores.

    Raises:
        InvalidConfig: if Ray is not installed, or no cluster answers.
    """
    ray = load_ray()
    if ray.is_initialized():
        return ray
    options: dict[str, Any] = {"logging_level": logging.WARNING, "log_to_driver": False}
    if address == LOCAL:
        # Ray would give its processes the least priority but four, so that any other program comes first.
        os.environ.setdefault("RAY_worker_niceness", "0")
        options |= {"include_dashboard": False, "object_store_memory": _LOCAL_STORE_BYTES}
        options["num_cpus"] = max(needs["CPU"], os.cpu_count() or 1)
        options["resources"] = {name: amount for name, amount in needs.items() if name not in {"CPU", "GPU"}}
    try:
        _require_server(address)
        with _signal_handlers_kept():
            ray.init(address, **options)
    except ray.exceptions.AuthenticationError as error:
        raise InvalidConfig(f"The Ray cluster at {address!r} needs a token: {error}", "ray") from error
    except (OSError, RuntimeError, ValueError) as error:
        # Ray says no more where a token is missing.
        hint = "" if address == LOCAL else " If it needs a token, set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN."
        raise InvalidConfig(f"No Ray cluster answers at {address!r}: {error}.{hint}", "ray") from error
    return ray


@contextmanager
def _signal_handlers_kept() -> Generator[None]:
    """Undo that Ray handles SIGTERM, by which commands stop in order."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)


def _require_server(address: str) -> None:
    """Raise OSError if nothing listens at HOST:PORT, for which Ray would wait two minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit() and "/" not in host:
        with socket.create_connection((host, int(port)), timeout=10):
            pass


def keeping_cores(wait: Callable[[], R]) -> R:
    """Wait for Ray, in a thread: on its main thread, a task that waits lends its cores to others, which then stay."""
    return _waiting_thread().submit(wait).result()


@cache
def _waiting_thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix="ray")


def connected() -> Any | None:
    """The package `ray` if this process belongs to a cluster, else None. Does not load it."""
    ray = sys.modules.get("ray")
    return ray if ray is not None and ray.is_initialized() else None


class _Started:
    """The first message of a job."""


class _Mailbox:
    """An actor beside the driver: takes the messages of jobs, and says whether they should end."""

    def __init__(self) -> None:
        self._messages: list[tuple[int, object]] = []
        self._cancelled = False

    def post(self, number: int, message: object) -> None:
        self._messages.append((number, message))

    def take(self) -> list[tuple[int, object]]:
        messages, self._messages = self._messages, []
        return messages

    def cancel(self) -> None:
        self._cancelled = True

    def cancelled(self) -> bool:
        """Whether jobs should end. Answered after all messages that the caller has posted."""
        return self._cancelled


class _DriverConnection(ParentConnection):
    """The connection of a job on a cluster to the command that started it."""

    def __init__(self, mailbox: Any, number: int) -> None:
        self._ray = load_ray()
        self._mailbox, self._number = mailbox, number
        self._asked_at, self._cancelled = 0.0, False

    def send(self, message: object) -> None:
        """See `ParentConnection.send`."""
        self._mailbox.post.remote(self._number, message)

    def cancelled(self) -> bool:
        """See `ParentConnection.cancelled`."""
        if not self._cancelled and time.monotonic() - self._asked_at >= _POLL_SECONDS:
            self._cancelled = self.flush()
            self._asked_at = time.monotonic()
        return self._cancelled

    def flush(self) -> bool:
        """Wait until the messages are delivered. Returns whether the job should end."""
        try:
            return keeping_cores(partial(self._ray.get, self._mailbox.cancelled.remote()))
        except self._ray.exceptions.RayActorError:
            return True  # the driver has ended


def _do_task(
    do_job: Callable[[Any, ParentConnection], object], job: object, number: int, mailbox: Any, folder: Path
) -> Outcome | None:
    """A job on a node. None if the command was stopped before it started."""
    driver = _DriverConnection(mailbox, number)
    if driver.cancelled():
        return None
    driver.send(_Started())
    if folder.is_dir():
        outcome = outcome_of(do_job, job, driver)
    else:
        outcome = Outcome(failure=f"its node has no folder {folder}, which all nodes of the cluster must share")
    driver.flush()
    return outcome


def _run_tasks(
    cluster: RayCluster,
    do_job: Callable[[J, ParentConnection], R],
    jobs: Sequence[J],
    n_workers: int,
    *,
    on_start: Callable[[J], None],
    on_message: Callable[[J, Any], None],
    should_stop: Callable[[], bool],
) -> Iterator[JobResult[J, R]]:
    ray = connect(cluster.address, {"CPU": cluster.job_cpus})
    mailbox = _start_mailbox(ray)
    task = ray.remote(_do_task).options(
        num_cpus=cluster.job_cpus,
        num_gpus=cluster.job_gpus,
        max_retries=MAX_RETRIES,
        runtime_env={"env_vars": task_environment(cluster.job_cpus)},
    )
    waiting = deque(enumerate(jobs))
    running: dict[Any, int] = {}
    started: set[int] = set()
    stopping = False

    def deliver() -> None:
        for number, message in ray.get(mailbox.take.remote()):
            if not isinstance(message, _Started):
                on_message(jobs[number], message)
            elif number not in started:  # it starts again where its node died
                started.add(number)
                on_start(jobs[number])

    try:
        while True:
            if not stopping and should_stop():
                stopping = True
                mailbox.cancel.remote()
                for reference in [each for each, number in running.items() if number not in started]:
                    # One that starts at this moment ends by itself.
                    ray.cancel(reference)
            while waiting and len(running) < n_workers and not stopping:
                number, job = waiting.popleft()
                running[task.remote(do_job, job, number, mailbox, cluster.folder)] = number
            if not running:
                return
            done, _ = ray.wait([*running], timeout=_POLL_SECONDS)
            deliver()
            for reference in done:
                number = running.pop(reference)
                outcome = _outcome_of_task(ray, reference)
                if outcome is not None:
                    yield JobResult(jobs[number], outcome.result, outcome.failure)
    finally:
        for reference in running:
            ray.cancel(reference, force=True)
        ray.kill(mailbox)


def _start_mailbox(ray: Any) -> Any:
    """The mailbox, on this node: if another node died with it, every job would end."""
    return ray.remote(_Mailbox).options(num_cpus=0, scheduling_strategy=here(ray)).remote()


def here(ray: Any) -> Any:
    """The scheduling strategy that places an actor on the node of this process."""
    strategies = import_module("ray.util.scheduling_strategies")
    return strategies.NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)


class ActorState(Enum):
    """Whether the process of an actor runs."""

    #: it waits for a node with room, or its process starts there
    PENDING = "pending"
    ALIVE = "alive"
    #: its process or node died, and it waits again
    RESTARTING = "restarting"
    DEAD = "dead"


#: of Ray's `ActorTableData.ActorState`
_ACTOR_STATES = {
    0: ActorState.PENDING,  # its arguments are not there
    1: ActorState.PENDING,
    2: ActorState.ALIVE,
    3: ActorState.RESTARTING,
    4: ActorState.DEAD,
}


def actor_state(actor: Any) -> ActorState | None:
    """The state of an actor that this process has called, as far as this process knows; None if it does not.

    Ray says it publicly only through its dashboard, which need not run.
    """
    return _ACTOR_STATES.get(actor._get_local_state())


def task_environment(cpus: int) -> dict[str, str]:
    """Environment of a process on the cluster that computes with this many threads."""
    own = {name: os.environ[name] for name in (TASK_FILES_VARIABLE,) if name in os.environ}
    return SHARED_CORES_ENVIRONMENT | {"OMP_NUM_THREADS": str(cpus)} | own


def _outcome_of_task(ray: Any, reference: Any) -> Outcome | None:
    """The outcome of a task that has ended; None if it did not start."""
    try:
        return ray.get(reference)
    except ray.exceptions.TaskCancelledError:
        return None
    except ray.exceptions.RayTaskError as error:  # before the job, such as a module that its node does not have
        return Outcome(failure=str(error).strip().splitlines()[-1])
    except ray.exceptions.RayError as error:
        return Outcome(failure=f"its process died {MAX_RETRIES + 1} times ({type(error).__name__})")
