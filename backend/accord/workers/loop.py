"""The loop every worker runs: is there work? do it; did it fail? record it, leave it alone for a while, go on."""

import argparse
import logging
import os
import random
import secrets
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from accord.domain.enums import WorkerRole
from accord.settings import Settings
from accord.store.blobs import BlobStore, open_blobs
from accord.store.database import Database
from accord.workers.backoff import Backoff
from accord.workers.lifeline import follow_parent
from accord.workers.pulse import Pulse
from accord.workers.sentence import sentence
from accord.workers.stop import Stop

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
        prog=f"python -m accord.workers.{role.value}",
        description=f"The {role.value} worker. Its settings are ACCORD_* variables.",
    )
    parser.add_argument("--slot", type=int, default=0, help="number among the workers of this role")
    parser.add_argument("--parent", type=int, default=0, help="pid to end with; 0 for none")
    return parser
