"""What the terminal of `accord up` says about the workers."""

import time
from collections.abc import Iterable

from sqlalchemy.exc import SQLAlchemyError

from accord.cli.output import note
from accord.domain.enums import WorkerRole
from accord.domain.errors import AccordError
from accord.services import workers
from accord.store.database import Database
from accord.workers.runner import RETRY_WORDS
from accord.workers.supervisor import ChildSpec, Death

_LOOK_SECONDS = 1.0


class Watch:
    """Reads the workers' rows once a second, and says once what is new about a failure."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._said: dict[str, str] = {}
        self._next_look = 0.0

    def begin(self, specs: Iterable[ChildSpec]) -> None:
        """Count the restarts of these workers from 0."""
        with self._database.transaction() as session:
            for spec in specs:
                if spec.role:
                    workers.report(session, spec.name, WorkerRole(spec.role), 0, "starting", restarts=0)

    def died(self, death: Death) -> None:
        """Print a death and write it on the worker's row, where the page finds it."""
        note(death.name, death.sentence)
        self._said[death.name] = death.sentence
        if not death.role:
            return
        try:
            with self._database.transaction() as session:
                workers.report(
                    session,
                    death.name,
                    WorkerRole(death.role),
                    0,
                    "backing_off",
                    death.sentence,
                    restarts=death.restarts,
                )
        except (AccordError, SQLAlchemyError) as error:
            note("accord", f"The death of {death.name} could not be recorded: {error}")

    def look(self) -> str | None:
        """A line about all workers, once a second; None in between. Failures are printed when they are new."""
        if time.monotonic() < self._next_look:
            return None
        self._next_look = time.monotonic() + _LOOK_SECONDS
        try:
            with self._database.reading() as session:
                rows = [(row.id, row.state, row.detail) for row in workers.all(session)]
        except (AccordError, SQLAlchemyError) as error:
            return f"The database does not answer: {error}"
        for id, state, detail in rows:
            self._say_failure(id, state, detail)
        return " · ".join(f"{id}: {detail if state == 'working' and detail else state}" for id, state, detail in rows)

    def _say_failure(self, id: str, state: str, detail: str) -> None:
        if state == "working":
            self._said.pop(id, None)
        if state != "backing_off":
            return
        # The pause grows with every try; the failure is the same.
        failure = detail.partition(RETRY_WORDS)[0].strip()
        if failure and self._said.get(id) != failure:
            self._said[id] = failure
            note(id, failure)
