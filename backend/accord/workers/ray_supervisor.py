"""Keeps workers running as actors of a Ray cluster: one for each role and slot, which runs the loop of that worker.

Ray places an actor on a node with room, and starts it again elsewhere when its process or its node dies. The rows hold
the work, so a dead actor is an expired lease and nothing more. `RaySupervisor` has the interface of `Supervisor`.
"""

import logging
import os
import random
import secrets
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from accord.domain.enums import WorkerRole
from accord.services import workers
from accord.settings import Settings
from accord.store.database import Database
from accord.workers.runner import Backoff, Stop
from accord.workers.supervisor import ChildSpec, Death
from mapt.cluster import connect, here, load_ray, task_environment
from mapt.processes import uncollected_imports

log = logging.getLogger(__name__)

#: a loop that ran this long has recovered: its next failure counts as the first in a row
_RECOVERED_SECONDS = 30.0
#: interval at which actors ask whether they should stop
_STOP_POLL_SECONDS = 0.5
#: interval at which the number of workers is compared with what is due
_SCALE_SECONDS = 5.0
#: a worker is stopped when there was too little for it to do for this long
_IDLE_SECONDS = 60.0


class _Stops:
    """An actor beside the supervisor: which actors should stop, by the key that the supervisor gave them."""

    def __init__(self) -> None:
        self._keys: set[str] = set()

    def add(self, key: str) -> None:
        self._keys.add(key)

    def contains(self, key: str) -> bool:
        return key in self._keys


class _WorkerActor:
    """A worker in a process of the cluster. It runs on the main thread, as in a process of its own."""

    def __init__(self, spec: ChildSpec, key: str, stops: Any) -> None:
        self._spec, self._key, self._stops = spec, key, stops

    def run(self) -> int:
        """Work until the supervisor says to stop, or has ended. Returns the exit status of the worker."""
        ray, spec = load_ray(), self._spec
        os.environ.update(spec.environment)
        os.nice(spec.nice)
        if ray.get_runtime_context().was_current_actor_reconstructed:
            _record_restart(spec, ray.get_runtime_context().get_node_id())
        threading.Thread(target=self._stop_when_told, args=(ray,), name="stops", daemon=True).start()
        module, *arguments = spec.arguments
        sys.argv = [module, *arguments]
        with uncollected_imports():
            worker = import_module(module)
        return worker.main()

    def _stop_when_told(self, ray: Any) -> None:
        try:
            while not ray.get(self._stops.contains.remote(self._key)):
                time.sleep(_STOP_POLL_SECONDS)
        except ray.exceptions.RayError:
            log.warning("The supervisor of %s has ended", self._spec.name)
        os.kill(os.getpid(), signal.SIGTERM)


def _record_restart(spec: ChildSpec, node: str) -> None:
    """Count in the worker's row that Ray has started it again."""
    settings = Settings()
    with closing(Database.open(settings.resolved_database_url)) as database, database.transaction() as session:
        detail = f"Its process or node died; it starts again on node {node[:8]}."
        workers.count_restart(session, settings.worker_id(spec.name), WorkerRole(spec.role), detail)


@dataclass(slots=True)
class _Slot:
    """A worker that should run."""

    spec: ChildSpec
    actor: Any = None
    #: of the actor, for `_Stops`
    key: str = ""
    #: of the call of its loop; None without an actor
    loop: Any = None
    started_at: float = 0.0
    #: failures in a row, and all restarts by this supervisor
    failures: int = 0
    restarts: int = 0
    #: when to start it again, while there is no actor
    due_at: float = 0.0
    #: since when there was too little to do for it; None if it is needed
    spare_since: float | None = None
    stopping: bool = False


class RaySupervisor:
    """Keeps one actor per spec running. It has no thread of its own: call `tick` a few times a second.

    Args:
        address: see `RayCluster`.
        specs: of workers. Their slots are numbered from 0 in each role.
        demand: number of workers of each role that have something to do; None runs all specs all the time.

    Raises:
        InvalidConfig: if Ray is not installed, or no cluster answers.
    """

    def __init__(
        self,
        address: str,
        specs: Sequence[ChildSpec],
        settings: Settings,
        on_death: Callable[[Death], None],
        *,
        demand: Callable[[], Mapping[WorkerRole, int]] | None = None,
    ) -> None:
        self._ray = connect(address)
        self._settings, self._on_death, self._demand = settings, on_death, demand
        self._slots = {spec.name: _Slot(spec) for spec in specs}
        self._stops = self._ray.remote(_Stops).options(num_cpus=0, scheduling_strategy=here(self._ray)).remote()
        self._backoff, self._rng = Backoff(), random.Random()
        #: (name, process id) of those that were killed because they hung
        self._killed: set[tuple[str, int]] = set()
        self._next_scale = 0.0

    def tick(self) -> None:
        """Start the workers that are due, and handle those whose loop has ended."""
        now = time.monotonic()
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
            self._stops.add.remote(slot.key)
        deadline = time.monotonic() + grace_seconds
        alive = running
        while alive and time.monotonic() < deadline and not stop.immediate:
            alive = [slot for slot in alive if not self._ray.wait([slot.loop], timeout=0.05)[0]]
        for slot in running:
            self._ray.kill(slot.actor)
        self._slots = {}
        return [slot.spec.name for slot in alive]

    def _start(self, slot: _Slot, now: float) -> None:
        role = WorkerRole(slot.spec.role)
        # A worker outlives its processes and nodes: Ray starts its actor again, and calls `run` again.
        options = {"max_restarts": -1, "max_task_retries": -1, "num_gpus": self._gpus(role)}
        if self._settings.ray_resources:
            options["resources"] = {role.value: 1}
        threads = int(slot.spec.environment.get("OMP_NUM_THREADS", "1"))
        environment = {"env_vars": task_environment(threads)}
        actor = self._ray.remote(_WorkerActor).options(**options, num_cpus=threads, runtime_env=environment)
        slot.key = secrets.token_hex(4)
        slot.actor = actor.remote(slot.spec, slot.key, self._stops)
        slot.loop, slot.started_at, slot.stopping = slot.actor.run.remote(), now, False

    def _gpus(self, role: WorkerRole) -> float:
        settings = self._settings
        return {WorkerRole.POLICY: settings.ray_policy_gpus, WorkerRole.REWARD: settings.ray_reward_gpus}.get(role, 0.0)

    def _handle_end(self, slot: _Slot, now: float) -> None:
        try:
            reason = f"Its loop ended with status {self._ray.get(slot.loop)}"
        except self._ray.exceptions.RayError as error:
            lines = str(error).strip().splitlines()
            reason = f"Its loop failed: {lines[-1] if lines else type(error).__name__}"
        self._ray.kill(slot.actor)
        slot.actor = slot.loop = None
        if slot.stopping:
            return
        slot.failures = 1 if now - slot.started_at > _RECOVERED_SECONDS else slot.failures + 1
        slot.restarts += 1
        pause = self._backoff.seconds(slot.failures, self._rng)
        slot.due_at = now + pause
        spec = slot.spec
        self._on_death(Death(spec.name, spec.role, f"{reason}. It restarts in {pause:.1f} s.", slot.restarts))

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
                elif slot.loop is not None and not slot.stopping and now - slot.spare_since > _IDLE_SECONDS:
                    slot.stopping = True
                    self._stops.add.remote(slot.key)
