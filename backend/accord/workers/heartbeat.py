"""The thread that says a worker is alive: its row for the page, and its claims for the other workers.

A thread, because one call of training lasts longer than a lease; short transactions of its own, because the worker's
may be long.
"""

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from accord.domain.enums import WorkerRole
from accord.domain.errors import AccordError
from accord.services import workers
from accord.store.database import Database

log = logging.getLogger(__name__)

#: the page learns of a change of state at most this often
_SHORTEST_SECONDS = 0.1


class ClaimLost(AccordError):
    """Another worker took this work over, since no heartbeat of this one arrived in time."""

    code = "claim_lost"

    def __init__(self, subject: str) -> None:
        super().__init__(f"The claim on {subject} expired and may be another's: this worker lets it go.")


#: renews a lease in an open transaction; False if it is another's by now
Renew = Callable[[Session], bool]


@dataclass(slots=True)
class Claim:
    """A piece of work this process holds, as far as it knows."""

    subject: str
    lease_seconds: float
    renew: Renew
    #: when the last heartbeat that succeeded was sent (monotonic)
    confirmed_at: float
    _lost: threading.Event = field(default_factory=threading.Event)

    @property
    def lost(self) -> bool:
        return self._lost.is_set() or time.monotonic() - self.confirmed_at > self.lease_seconds

    def beat(self, session: Session) -> bool:
        """Renew the lease. Returns whether it still was this process's."""
        if not self.renew(session):
            self._lost.set()
        return not self._lost.is_set()

    def check(self) -> None:
        """Raises ClaimLost if the work may be another's by now."""
        if self.lost:
            raise ClaimLost(self.subject)

    def check_within(self, session: Session) -> None:
        """The same, certain: renewed in the transaction that publishes. Raises ClaimLost, which rolls it back."""
        self.check()
        if not self.beat(session):
            raise ClaimLost(self.subject)


class Pulse:
    """Heartbeats of one worker process."""

    def __init__(self, database: Database, worker_id: str, role: WorkerRole, holder: str, lease_seconds: float) -> None:
        """
        Args:
            worker_id: role and slot; a restarted process takes its predecessor's row.
            holder: unique to this process, so that it cannot be taken for a predecessor that still lives.
            lease_seconds: how long a claim lasts without a heartbeat; it gets four in that time.
        """
        self._database = database
        self._worker_id = worker_id
        self._role = role
        self._holder = holder
        self._lease_seconds = lease_seconds
        self._state, self._detail = "starting", ""
        self._claims: dict[str, Claim] = {}
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="pulse", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Say "stopped" and end the thread."""
        self._ended = True
        self._wake.set()
        self._thread.join(timeout=self._lease_seconds)
        self.say("stopped")
        self._beat()

    def say(self, state: str, detail: str = "") -> None:
        """Show this on the page soon. Never waits."""
        if (state, detail) != (self._state, self._detail):
            self._state, self._detail = state, detail
            self._wake.set()

    @contextmanager
    def hold(self, subject: str) -> Iterator[Claim | None]:
        """Claim `subject` for the block and release it after; None when another holds it."""
        with self._database.transaction() as session:
            taken = workers.claim(session, subject, self._holder, self._lease_seconds)
        if not taken:
            yield None
            return
        with self.keep(
            subject, lambda session: workers.heartbeat(session, subject, self._holder, self._lease_seconds)
        ) as claim:
            try:
                yield claim
            finally:
                with self._database.transaction() as session:
                    workers.release(session, subject, self._holder)

    @contextmanager
    def keep(self, subject: str, renew: Renew) -> Iterator[Claim]:
        """Renew a lease that was just taken, for as long as the block lasts."""
        claim = Claim(subject, self._lease_seconds, renew, time.monotonic())
        with self._lock:
            self._claims[subject] = claim
        try:
            yield claim
        finally:
            with self._lock:
                del self._claims[subject]

    def _run(self) -> None:
        while not self._ended:
            self._beat()
            # A change of state is shown soon, a burst of changes as one.
            self._wake.wait(self._lease_seconds / 4)
            time.sleep(_SHORTEST_SECONDS)
            self._wake.clear()

    def _beat(self) -> None:
        sent_at = time.monotonic()
        try:
            with self._database.transaction() as session:
                workers.report(session, self._worker_id, self._role, os.getpid(), self._state, self._detail)
                with self._lock:
                    held = list(self._claims.values())
                kept = [claim for claim in held if claim.beat(session)]
        except (SQLAlchemyError, AccordError):
            # The claims grow old meanwhile and are given up when their leases are over.
            log.exception("No heartbeat")
            return
        for claim in kept:
            claim.confirmed_at = sent_at
