"""Keeps workers running as actors of a Ray cluster: one for each role and slot, which runs the loop of that worker.

Ray places an actor on a node with room, and starts it again elsewhere when its process or its node dies. The rows hold
the work, so a dead actor is an expired lease and nothing more. `RaySupervisor` has the interface of `Supervisor`, and
writes the same logs: actors send it what they write to theirs. A worker that runs writes its own row; the supervisor
says what becomes of one that does not.
"""

import logging
import os
import random
import secrets
import signal
import socket
import stat
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from accord.domain.enums import WorkerRole, WorkerState
from accord.services import workers
from accord.settings import Settings
from accord.store.database import Database
from accord.workers.runner import Backoff, Stop
from accord.workers.supervisor import LOG_BYTES, ChildSpec, Death, last_line, rotate
from mapt.cluster import ActorState, actor_state, connect, here, load_ray, task_environment
from mapt.processes import uncollected_imports

log = logging.getLogger(__name__)

#: a loop that ran this long has recovered: its next failure counts as the first in a row
_RECOVERED_SECONDS = 30.0
#: interval at which actors send their logs and ask whether they should stop, and at which the logs are written
_REPORT_SECONDS = 0.5
#: most of a worker's log that waits to be written; what is older is lost
_WAITING_LOG_BYTES = 1_000_000
#: interval at which the number of workers is compared with what is due
_SCALE_SECONDS = 5.0
#: a worker is stopped when there was too little for it to do for this long
_IDLE_SECONDS = 60.0
#: interval at which the supervisor looks for workers that wait for a node, and at which it says so again
_LOOK_SECONDS = 2.0
_WAITING_SECONDS = 10.0
#: a worker that was started for less is not said to wait, so that the reason of its last end can be read
_START_SECONDS = 10.0


class WorkerRows(Protocol):
    """Takes what the supervisor knows about workers, for people to see."""

    def record_death(self, death: Death) -> None:
        """A worker failed, and starts again."""
        ...

    def record_waiting(self, spec: ChildSpec, state: WorkerState, detail: str) -> None:
        """A worker should run, but no process of it does."""
        ...

    def forget(self, spec: ChildSpec) -> None:
        """A worker is not needed now."""
        ...


class _Reports:
    """An actor beside the supervisor, to which workers report: it takes their logs, and knows which should stop.

    When its process dies, Ray starts it again. Workers and supervisor say again what it has forgotten.
    """

    def __init__(self) -> None:
        self._stopping: set[str] = set()
        #: by the name of the worker: what was not written yet, and the last line
        self._logs: dict[str, bytes] = {}
        self._last_lines: dict[str, str] = {}

    def stop(self, key: str) -> None:
        """Let the actor stop to which the supervisor gave this key."""
        self._stopping.add(key)

    def report(self, name: str, key: str, log: bytes) -> bool:
        """Take what a worker has added to its log. Returns whether it should stop."""
        if log:
            self._logs[name] = (self._logs.get(name, b"") + log)[-_WAITING_LOG_BYTES:]
            self._last_lines[name] = last_line(log) or self.last_line(name)
        return key in self._stopping

    def take_logs(self) -> dict[str, bytes]:
        """What workers added to their logs since the last call, by name."""
        taken, self._logs = self._logs, {}
        return taken

    def last_line(self, name: str) -> str:
        """The last line of a worker's log; empty if there is none."""
        return self._last_lines.get(name, "")


class _WorkerActor:
    """A worker in a process of the cluster. It runs on the main thread, as in a process of its own."""

    def run(self, spec: ChildSpec, key: str, reports: Any) -> int:
        """Work until the supervisor says to stop, or has ended. Returns the exit status of the worker.

        Args:
            spec: of the worker.
            key: of this actor, for `reports`.
            reports: an actor; see `_Reports`.
        """
        self._spec, self._key, self._reports = spec, key, reports
        ray = load_ray()
        os.environ.update(spec.environment)
        os.nice(spec.nice)
        node = f"{socket.gethostname()}, node {ray.get_runtime_context().get_node_id()[:8]}"
        if ray.get_runtime_context().was_current_actor_reconstructed:
            _record_restart(spec, node, ray.get(self._reports.last_line.remote(spec.name)))
        self._log: BinaryIO | None = _own_log()
        print(f"{spec.name} starts on {node}", file=sys.stderr, flush=True)
        threading.Thread(target=self._report_until_told_to_stop, args=(ray,), name="reports", daemon=True).start()
        module, *arguments = spec.arguments
        sys.argv = [module, *arguments]
        with uncollected_imports():
            worker = import_module(module)
        try:
            return worker.main()
        finally:
            with suppress(ray.exceptions.RayError):  # the supervisor has ended
                self._report(ray)

    def _report_until_told_to_stop(self, ray: Any) -> None:
        try:
            while not self._report(ray):
                time.sleep(_REPORT_SECONDS)
        except ray.exceptions.RayError:
            log.warning("The supervisor of %s has ended", self._spec.name)
        os.kill(os.getpid(), signal.SIGTERM)

    def _report(self, ray: Any) -> bool:
        """Send what was added to the log. Returns whether this worker should stop."""
        added = self._log.read() if self._log is not None else b""
        return ray.get(self._reports.report.remote(self._spec.name, self._key, added))


def _own_log() -> BinaryIO | None:
    """What this process writes to standard error from now on, which Ray directs to a file; None if it is no file."""
    if not stat.S_ISREG(os.fstat(2).st_mode):
        return None
    file = open("/dev/fd/2", "rb")  # noqa: SIM115  (as long as the process)
    file.seek(0, os.SEEK_END)
    return file


def _record_restart(spec: ChildSpec, node: str, logged: str) -> None:
    """Count in the worker's row that Ray has started it again.

    Args:
        logged: the last line that it logged.
    """
    settings = Settings()
    detail = _with_last_line(f"Its process or node died; it starts again on {node}.", logged)
    with closing(Database.open(settings.resolved_database_url)) as database, database.transaction() as session:
        workers.count_restart(session, settings.worker_id(spec.name), WorkerRole(spec.role), detail)


def _with_last_line(detail: str, logged: str) -> str:
    """What became of a worker, with the last line of its log, if any."""
    return f"{detail} Last line of its log: {logged}" if logged else detail


@dataclass(slots=True)
class _Slot:
    """A worker that should run."""

    spec: ChildSpec
    actor: Any = None
    #: of the actor, for `_Reports`
    key: str = ""
    #: of the call of its loop; None without an actor
    loop: Any = None
    started_at: float = 0.0
    #: in a row
    failures: int = 0
    #: when to start it again, while there is no actor
    due_at: float = 0.0
    #: since when there was too little to do for it; None if it is needed
    spare_since: float | None = None
    stopping: bool = False
    #: what its row was told last of the process that does not run, and when
    waiting: ActorState | None = None
    waiting_at: float = 0.0


class RaySupervisor:
    """Keeps one actor per spec running. It has no thread of its own: call `tick` a few times a second.

    Args:
        address: see `RayCluster`.
        specs: of workers. Their slots are numbered from 0 in each role.
        log_folder: gets a log for each worker, as that of a process of this machine.
        rows: told of workers of which no process runs.
        demand: number of workers of each role that have something to do; None runs all specs all the time.

    Raises:
        InvalidConfig: if Ray is not installed, or no cluster answers.
    """

    def __init__(
        self,
        address: str,
        specs: Sequence[ChildSpec],
        settings: Settings,
        log_folder: Path,
        rows: WorkerRows,
        *,
        demand: Callable[[], Mapping[WorkerRole, int]] | None = None,
    ) -> None:
        needs = Counter[str]()
        for spec in specs:
            needs.update(_needs(spec, settings))
        self._ray = connect(address, needs)
        self._settings, self._log_folder, self._rows, self._demand = settings, log_folder, rows, demand
        self._slots = {spec.name: _Slot(spec) for spec in specs}
        beside = {"num_cpus": 0, "scheduling_strategy": here(self._ray), "max_restarts": -1, "max_task_retries": -1}
        self._reports = self._ray.remote(_Reports).options(**beside).remote()
        self._backoff, self._rng = Backoff(), random.Random()
        #: (name, process id) of those that were killed because they hung
        self._killed: set[tuple[str, int]] = set()
        self._next_scale = self._next_log = self._next_look = 0.0

    def tick(self) -> None:
        """Start the workers that are due, handle those whose loop has ended, and write their logs."""
        now = time.monotonic()
        if now >= self._next_log:
            self._next_log = now + _REPORT_SECONDS
            self._write_logs()
        if self._demand is not None and now >= self._next_scale:
            self._next_scale = now + _SCALE_SECONDS
            self._scale(self._demand(), now)
        for slot in self._slots.values():
            if slot.loop is not None:
                ended, _ = self._ray.wait([slot.loop], timeout=0)
                if ended:
                    self._handle_end(slot, now)
            elif now >= slot.due_at and slot.spare_since is None:
                self._start(slot, now)
        if now >= self._next_look:
            self._next_look = now + _LOOK_SECONDS
            for slot in self._slots.values():
                if slot.loop is not None:
                    self._look(slot, now)

    def kill(self, name: str, pid: int) -> bool:
        """Kill a worker that hangs; Ray starts it again. Returns False if that was done already."""
        slot = self._slots.get(name)
        if slot is None or slot.actor is None or (name, pid) in self._killed:
            return False
        self._killed.add((name, pid))
        self._ray.kill(slot.actor, no_restart=False)
        return True

    def shutdown(self, stop: Stop, grace_seconds: float = 8.0) -> list[str]:
        """Stop all workers: ask, wait, then kill those that still run; kill at once if `stop` is immediate.

        Returns:
            Names of the workers that had to be killed.
        """
        running = [slot for slot in self._slots.values() if slot.loop is not None]
        for slot in running:
            self._reports.stop.remote(slot.key)
        deadline = time.monotonic() + grace_seconds
        alive = [slot for slot in running if _may_run(slot.actor)]
        while alive and time.monotonic() < deadline and not stop.immediate:
            alive = [slot for slot in alive if not self._ray.wait([slot.loop], timeout=0.05)[0]]
        self._write_logs()
        for slot in running:
            self._ray.kill(slot.actor)
        self._slots = {}
        return [slot.spec.name for slot in alive]

    def _start(self, slot: _Slot, now: float) -> None:
        # A worker outlives its processes and nodes: Ray starts its actor again, and calls `run` again.
        options: dict[str, Any] = {"max_restarts": -1, "max_task_retries": -1}
        needs = _needs(slot.spec, self._settings)
        options |= {"num_cpus": needs.pop("CPU"), "num_gpus": needs.pop("GPU"), "resources": needs}
        environment = {"env_vars": task_environment(_threads(slot.spec))}
        actor = self._ray.remote(_WorkerActor).options(**options, runtime_env=environment)
        slot.key = secrets.token_hex(4)
        slot.actor = actor.remote()
        slot.loop, slot.started_at, slot.stopping = (
            slot.actor.run.remote(slot.spec, slot.key, self._reports),
            now,
            False,
        )

    def _look(self, slot: _Slot, now: float) -> None:
        """Say of a worker that Ray has not started, or not started again, what it waits for."""
        state = actor_state(slot.actor)
        if state is slot.waiting and now - slot.waiting_at < _WAITING_SECONDS:
            return
        needs = ", ".join(f"{name}: {amount:g}" for name, amount in _needs(slot.spec, self._settings).items() if amount)
        waits = f"aits for a node with room ({needs}), or is starting there."
        if state is ActorState.PENDING and now - slot.started_at >= _START_SECONDS:
            self._rows.record_waiting(slot.spec, WorkerState.STARTING, f"W{waits}")
        elif state is ActorState.RESTARTING:
            detail = _with_last_line(f"Its process or node died; it w{waits}", self._last_line(slot.spec.name))
            self._rows.record_waiting(slot.spec, WorkerState.RESTARTING, detail)
        else:
            state = None
        slot.waiting, slot.waiting_at = state, now

    def _handle_end(self, slot: _Slot, now: float) -> None:
        self._write_logs()
        try:
            reason = f"Its loop ended with status {self._ray.get(slot.loop)}"
        except self._ray.exceptions.RayError as error:
            failure = str(error).encode()
            self._append(slot.spec.name, failure + b"\n")
            reason = f"Its loop failed: {last_line(failure) or type(error).__name__}"
        self._ray.kill(slot.actor)
        slot.actor = slot.loop = None
        spec = slot.spec
        if not slot.stopping:
            slot.failures = 1 if now - slot.started_at > _RECOVERED_SECONDS else slot.failures + 1
            pause = self._backoff.seconds(slot.failures, self._rng)
            slot.due_at = now + pause
            self._rows.record_death(Death(spec.name, spec.role, f"{reason}. It restarts in {pause:.1f} s."))
        if slot.spare_since is not None:
            self._rows.forget(spec)

    def _last_line(self, name: str) -> str:
        with suppress(self._ray.exceptions.RayError):  # the cluster has ended
            return self._ray.get(self._reports.last_line.remote(name))
        return ""

    def _write_logs(self) -> None:
        with suppress(self._ray.exceptions.RayError):  # the cluster has ended
            for name, added in self._ray.get(self._reports.take_logs.remote()).items():
                self._append(name, added)

    def _append(self, name: str, added: bytes) -> None:
        path = self._log_folder / f"{name}.log"
        with suppress(OSError):  # a full disk must not end the workers
            rotate(path, LOG_BYTES)
            with path.open("ab") as file:
                file.write(added)

    def _scale(self, demand: Mapping[WorkerRole, int], now: float) -> None:
        """Start workers when there is more to do, and stop the last ones of a role that had nothing to do for long."""
        for role, wanted in demand.items():
            of_role = [slot for slot in self._slots.values() if slot.spec.role == role.value]
            for number, slot in enumerate(of_role):
                if number < max(1, wanted):
                    slot.spare_since = None
                elif slot.spare_since is None:
                    # One that has not started waits for more to do.
                    slot.spare_since = now
                    if slot.loop is None:
                        self._rows.forget(slot.spec)
                elif slot.loop is not None and now - slot.spare_since > _IDLE_SECONDS:
                    self._stop(slot)

    def _stop(self, slot: _Slot) -> None:
        """Let a worker stop that is not needed now; `tick` handles its end."""
        if _may_run(slot.actor):
            slot.stopping = True
            self._reports.stop.remote(slot.key)
        else:
            # It hears of nothing, and Ray's autoscaler would add a node for it.
            self._ray.kill(slot.actor)
            slot.actor = slot.loop = None
            self._rows.forget(slot.spec)


def _may_run(actor: Any) -> bool:
    """Whether a process of the actor may run, which can be told to stop."""
    return actor_state(actor) not in {ActorState.PENDING, ActorState.RESTARTING}


def _needs(spec: ChildSpec, settings: Settings) -> dict[str, float]:
    """What a worker takes of a node, by the names of Ray's resources."""
    gpus = {WorkerRole.POLICY.value: settings.ray_policy_gpus, WorkerRole.REWARD.value: settings.ray_reward_gpus}
    needs: dict[str, float] = {"CPU": _threads(spec), "GPU": gpus.get(spec.role, 0.0)}
    if settings.ray_resources:
        needs[spec.role] = 1
    return needs


def _threads(spec: ChildSpec) -> int:
    """Threads that a worker computes with, each of which takes a core."""
    return int(spec.environment.get("OMP_NUM_THREADS", "1"))
