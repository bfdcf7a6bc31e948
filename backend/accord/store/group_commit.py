"""Group commit for SQLite: concurrent transactions of one process share one commit.

A commit waits 1 to 10 ms for the disk, and SQLite has one writer at a time: with one commit per request, 16 labellers
would wait for 16 commits in turn. Instead, threads that want to write at the same time take turns within one open
transaction, each in its own savepoint, and the last one commits for all. Every thread waits for that commit: when a
block ends, what it wrote is on disk, or the block raises.
"""

import sqlite3
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import cast

from sqlalchemy import Connection, Engine
from sqlalchemy.exc import DatabaseError
from sqlalchemy.orm import Session

#: a group is committed at this size even if more threads wait, since other processes want to write as well
LARGEST_GROUP = 64


class CommitFailed(Exception):
    """The shared transaction failed, and nothing of any of its members was written. `__cause__` says why."""


class _Group:
    """One open transaction and the number of blocks that ran in it."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.members = 0
        #: why the transaction cannot be committed; None while it can
        self.error: BaseException | None = None
        self._ended = threading.Event()

    @contextmanager
    def member(self) -> Generator[Session]:
        """A session within its own savepoint, which is rolled back if the block raises."""
        self.members += 1
        with Session(self.connection, expire_on_commit=False, join_transaction_mode="create_savepoint") as session:
            try:
                yield session
                session.commit()
            except BaseException as error:
                self._undo(session, error)
                raise

    def _undo(self, session: Session, error: BaseException) -> None:
        """Rolls one member back, or marks the whole group as failed where that cannot be done.

        On SQLITE_FULL, SQLITE_IOERR and SQLITE_NOMEM, SQLite may roll the whole transaction back, with the savepoints
        of the members before. A COMMIT would then succeed and write nothing.
        """
        try:
            session.rollback()
        except DatabaseError:
            self.error = _first_of(error)
        if not self._in_transaction():
            self.error = _first_of(error)

    def _in_transaction(self) -> bool:
        if self.connection.invalidated:
            return False
        driver = cast(sqlite3.Connection, self.connection.connection.dbapi_connection)
        return driver.in_transaction

    def end(self) -> None:
        """Commits for all members, or closes the connection if the group has failed."""
        try:
            if self.error is None:
                self.connection.commit()
        except Exception as error:  # noqa: BLE001 (every member raises it)
            self.error = error
        finally:
            if self.error is not None:
                # The state of the connection is unknown; closing it rolls back whatever is still open.
                self.connection.invalidate(self.error)
            self.connection.close()
            self._ended.set()

    def wait(self) -> None:
        """Waits for the commit. Raises CommitFailed if the group failed."""
        self._ended.wait()
        if self.error is not None:
            raise CommitFailed(str(self.error)) from self.error


def _first_of(error: BaseException) -> BaseException:
    """The database's first error: a session that rolls back after it raises a second one, `no such savepoint`."""
    first = error
    while error.__context__ is not None:
        error = error.__context__
        if isinstance(error, DatabaseError):
            first = error
    return first


class GroupCommit:
    """Sessions over one SQLite database whose writes are committed in groups."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._turn = threading.Lock()
        self._owner: int | None = None
        self._waiting = 0
        self._waiting_lock = threading.Lock()
        self._group: _Group | None = None

    @contextmanager
    def session(self) -> Generator[Session]:
        """A session whose writes are committed when the block ends, or rolled back if it raises.

        Raises:
            CommitFailed: if they could not be committed.
            RuntimeError: if this thread is in such a block already, which would be a deadlock.
        """
        if self._owner == threading.get_ident():
            raise RuntimeError("this thread already has an open transaction")
        group: _Group | None = None
        self._queue_up()
        try:
            try:
                self._owner = threading.get_ident()
                group = self._group or self._begin()
                with group.member() as session:
                    yield session
            finally:
                if group is not None:
                    self._leave(group)
                self._owner = None
                self._turn.release()
        finally:
            # Also if the block raised: what made it raise may have been written by an earlier member.
            if group is not None:
                group.wait()

    def _queue_up(self) -> None:
        self._count(1)
        try:
            self._turn.acquire()
        finally:
            self._count(-1)

    def _count(self, change: int) -> None:
        with self._waiting_lock:
            self._waiting += change

    def _begin(self) -> _Group:
        connection = self._engine.connect()
        try:
            connection.begin()
        except BaseException:
            connection.close()
            raise
        self._group = _Group(connection)
        return self._group

    def _leave(self, group: _Group) -> None:
        """Ends the group, unless another thread waits for its turn: that one ends it, or the one after it."""
        if self._waiting == 0 or group.members >= LARGEST_GROUP or group.error is not None:
            self._group = None
            group.end()
