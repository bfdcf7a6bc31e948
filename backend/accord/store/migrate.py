"""Migrates a database to the tables of this version.

A module of its own, so that worker processes do not import Alembic.
"""

from functools import cache
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, text

from accord.domain.errors import DatabaseTooNew, DatabaseTooOld
from accord.store.database import Database

_SCRIPTS = Path(__file__).parent / "migrations"
#: an arbitrary number, the same in every version; the lock keeps two processes from migrating at once
_POSTGRES_LOCK = 7_264_001


def migrate(database: Database) -> None:
    """Migrates the tables to this version; does nothing if they are up to date.

    Raises:
        DatabaseTooNew: if a newer version of Accord has migrated it.
        DatabaseUnreachable: if it cannot be reached or written.
    """
    with database.connection() as connection:
        _upgrade(connection)


def is_new(database: Database) -> bool:
    """Whether no version of Accord has ever migrated it.

    Raises:
        DatabaseUnreachable: if it cannot be reached.
    """
    return revision(database) is None


def is_current(database: Database) -> bool:
    """Whether no migration is missing.

    Raises:
        DatabaseTooNew, DatabaseUnreachable: as `migrate`.
    """
    with database.reading() as session:
        return _is_current(session.connection())


def revision(database: Database) -> str | None:
    """The revision of the tables; None if no version of Accord has ever migrated them.

    Raises:
        DatabaseUnreachable: if it cannot be reached.
    """
    with database.connection() as connection:
        return MigrationContext.configure(connection).get_current_revision()


def require_known(revision: str | None) -> None:
    """Raises DatabaseTooNew if this version of Accord does not know the revision of a database."""
    known = {script.revision for script in _scripts().walk_revisions()}
    if revision is not None and revision not in known:
        raise DatabaseTooNew(
            f"The database is at revision {revision!r}, which this version of Accord does not know: a newer version "
            "has migrated it. Use that version, or choose another database with ACCORD_HOME or ACCORD_DATABASE_URL."
        )


def require_current(database: Database) -> None:
    """
    Raises:
        DatabaseTooOld: if a migration is missing.
        DatabaseTooNew, DatabaseUnreachable: as `migrate`.
    """
    if not is_current(database):
        raise DatabaseTooOld(
            f"The database {database.name} is of an earlier version of Accord. Start `accord up`, which migrates it, "
            "then try again."
        )


def alembic_config(connection: Connection) -> Config:
    """Alembic's configuration for one connection; no alembic.ini is needed."""
    made = Config()
    made.set_main_option("script_location", str(_SCRIPTS).replace("%", "%%"))
    made.set_main_option("path_separator", "os")
    made.attributes["connection"] = connection
    return made


def _upgrade(connection: Connection) -> None:
    """Runs the missing migrations within the connection's transaction.

    Raises:
        DatabaseTooNew: if the database holds a revision that this version does not know.
    """
    if connection.dialect.name == "postgresql":
        connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _POSTGRES_LOCK})
    if not _is_current(connection):
        command.upgrade(alembic_config(connection), "head")


@cache
def _scripts() -> ScriptDirectory:
    """All migrations. Kept, because it takes 30 ms to read them, and readiness is asked for again and again."""
    return ScriptDirectory(str(_SCRIPTS))


def _is_current(connection: Connection) -> bool:
    """Whether the database is at the newest revision. Raises DatabaseTooNew as `_upgrade`."""
    current = MigrationContext.configure(connection).get_current_revision()
    require_known(current)
    return current == _scripts().get_current_head()
