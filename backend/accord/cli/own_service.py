"""A whole Accord of one's own, as a child process: what `accord demo` runs against."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from accord.cli.options import address_file, load_settings
from accord.domain.enums import Role
from accord.domain.errors import Unavailable
from accord.services import accounts
from accord.store import accounts as users
from accord.store.database import Database

#: this file in a home says that it serves a demo alone
_MARK = "own-service"
#: imports and migrations of a busy machine
_START_SECONDS = 60.0
#: longer than the supervisor's own grace
_END_SECONDS = 20.0


class OwnService:
    """`accord up` on a free port with a home of its own; ended at the end of the block."""

    def __init__(self, home: Path, environment: Mapping[str, str], stopped: Callable[[], bool] = bool) -> None:
        """
        Args:
            home: a folder without a database, or one that another of these made.
            environment: ACCORD_* variables besides.
            stopped: asked while waiting for the start; true gives up.

        Raises:
            Unavailable: if there is a database of another service.
        """
        mark = home / _MARK
        if (home / "accord.db").exists() and not mark.exists():
            raise Unavailable(f"{home} holds the database of another service. Choose another folder with --home.")
        self.home = home
        self._stopped = stopped
        self._settings = load_settings(home)
        self._log = home / "logs" / "up.log"
        self._log.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()
        # Of a service that was killed: nobody listens there.
        address_file(self._settings).unlink(missing_ok=True)
        command = [sys.executable, "-m", "accord.cli", "up", "--home", str(home), "--port", "0", "--no-example"]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [*command, "--parent", str(os.getpid())],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=os.environ | dict(environment),
                start_new_session=True,  # Ctrl-C on the terminal reaches the demo alone, which ends the service
            )

    def url(self) -> str:
        """Where it listens. Waits for its start.

        Raises:
            Unavailable: if it does not come up; the message is its own.
        """
        path, deadline = address_file(self._settings), time.monotonic() + _START_SECONDS
        while not path.exists():
            self.check()
            if time.monotonic() > deadline or self._stopped():
                raise Unavailable(f"The service did not start in {_START_SECONDS:.0f} s. See {self._log}.")
            time.sleep(0.05)
        return path.read_text().strip()

    def check(self) -> None:
        """Raises Unavailable if the service has ended by itself."""
        if self._process.poll() is not None:
            lines = self._log.read_text(errors="replace").strip().splitlines()
            raise Unavailable(f"The service ended: {lines[-1] if lines else 'it said nothing'}")

    def token(self, name: str, role: Role) -> str:
        """Another bearer token of the user with this name, who is made where there is none."""
        database = Database.open(load_settings(self.home).resolved_database_url)
        try:
            with database.transaction() as session:
                user = users.user_by_name(session, name)
                if user is None:
                    return accounts.create_user(session, name, role)[1]
                return accounts.new_bearer(session, user.id)
        finally:
            database.close()

    def close(self) -> None:
        """End the service and everything it started."""
        if self._process.poll() is None:
            self._process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_END_SECONDS)
        # Its children follow it: see accord.workers.runner.
        self._process.kill()
        self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
