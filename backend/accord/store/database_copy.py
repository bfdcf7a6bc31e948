"""Copies of a database, made while other processes write to it, and their restoration."""

import os
import shutil
import sqlite3
import subprocess
from collections.abc import Generator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from sqlalchemy import delete, inspect, text
from sqlalchemy.engine import URL, make_url
from sqlalchemy.orm import Session

from accord.domain.errors import Unavailable
from accord.store.database import Database, sqlite_file
from accord.store.tables import ClaimRow
from mapt.io import atomic_path


class DatabaseNotEmpty(Unavailable):
    """The database to restore into exists already, or has tables."""

    code = "database_not_empty"


class DatabaseNotCopied(Unavailable):
    """A program of PostgreSQL is missing or failed."""

    code = "database_not_copied"


def file_name(database: Database) -> str:
    """Name of the file that `copied` writes."""
    return "accord.db" if database.is_sqlite else "accord.dump"


@contextmanager
def copied(database: Database, folder: Path) -> Generator[Session]:
    """Writes a copy of the database into a folder, and yields a session that reads the same rows as the copy has.

    Transactions that are committed when it begins are in the copy. Writers are not blocked.

    Raises:
        DatabaseUnreachable: if the database cannot be reached.
        DatabaseNotCopied: if pg_dump is missing or fails.
        OSError: if the folder cannot be written.
    """
    target = folder / file_name(database)
    if database.is_sqlite:
        _copy_sqlite(database, target)
        with closing(Database.open(f"sqlite:///{target}")) as copy, copy.reading() as session:
            yield session
        return
    with database.engine.connect().execution_options(isolation_level="REPEATABLE READ") as connection:
        # The snapshot makes pg_dump read the same rows as the session.
        snapshot = connection.execute(text("SELECT pg_export_snapshot()")).scalar_one()
        arguments = ["--format=custom", "--no-owner", "--no-privileges", f"--snapshot={snapshot}", f"--file={target}"]
        _run("pg_dump", arguments, database.engine.url)
        with Session(connection) as session:
            yield session


def require_new(url: str) -> None:
    """
    Raises:
        DatabaseNotEmpty: if the database exists (SQLite) or has tables (PostgreSQL).
        DatabaseUnreachable: if it cannot be reached.
    """
    file = sqlite_file(url)
    if file is not None:
        if file.exists():
            raise DatabaseNotEmpty(f"There is a database at {file} already. Restore into another, empty home folder.")
        return
    with closing(Database.open(url)) as database, database.reading() as session:
        if inspect(session.connection()).get_table_names():
            raise DatabaseNotEmpty(
                f"The database {database.name} has tables already. Create an empty one, for example with createdb, and "
                "set ACCORD_DATABASE_URL to it."
            )


def restore(copy: Path, url: str) -> None:
    """Creates the database from its copy. Nobody holds a claim in it.

    Raises:
        DatabaseNotCopied: if pg_restore is missing or fails; the database is then empty.
        OSError: if the file cannot be written.
    """
    file = sqlite_file(url)
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        # The file has its name once it is complete.
        with atomic_path(file) as temporary:
            shutil.copyfile(copy, temporary)
            _delete_claims(f"sqlite:///{temporary}")
    else:
        arguments = ["--single-transaction", "--exit-on-error", "--no-owner", "--no-privileges", str(copy)]
        _run("pg_restore", arguments, make_url(url))
        _delete_claims(url)


def _delete_claims(url: str) -> None:
    with closing(Database.open(url)) as database, database.transaction() as session:
        session.execute(delete(ClaimRow))


def _copy_sqlite(database: Database, target: Path) -> None:
    # In one step, because a copy in several begins again after each commit of another process.
    with closing(sqlite3.connect(target)) as copy, database.reading() as session:
        source = session.connection().connection.driver_connection
        assert isinstance(source, sqlite3.Connection)
        source.backup(copy)


def _run(program: str, arguments: Sequence[str], url: URL) -> None:
    """Runs a program of PostgreSQL. The password is not an argument, which other users of the machine could read."""
    dbname = url.set(drivername="postgresql", password=None).render_as_string(hide_password=False)
    environment = os.environ | ({"PGPASSWORD": url.password} if url.password else {})
    command = [program, "--no-password", f"--dbname={dbname}", *arguments]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise DatabaseNotCopied(f"{program} is not installed: apt-get install postgresql-client.") from error
    if done.returncode:
        reason = (done.stderr.strip() or "without a message").splitlines()[0]
        raise DatabaseNotCopied(f"{program} failed: {reason}. Its version must not be older than the server's.")
