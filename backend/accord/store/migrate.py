"""Alembic, run inside the process that opens the database, on a connection it is given."""

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, text

from accord.domain.errors import DatabaseTooNew

_SCRIPTS = Path(__file__).parent / "migrations"
#: any number, the same in every version: it keeps two starting processes from migrating at once
_POSTGRES_LOCK = 7_264_001


def config(connection: Connection) -> Config:
    """Alembic's configuration for one connection; no alembic.ini is needed."""
    made = Config()
    made.set_main_option("script_location", str(_SCRIPTS).replace("%", "%%"))
    made.set_main_option("path_separator", "os")
    made.attributes["connection"] = connection
    return made


def upgrade(connection: Connection) -> None:
    """Runs the migrations that are missing, within the connection's transaction.

    Raises:
        DatabaseTooNew: if the database holds a revision that this version does not know.
    """
    if connection.dialect.name == "postgresql":
        connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _POSTGRES_LOCK})
    settings = config(connection)
    scripts = ScriptDirectory.from_config(settings)
    current = MigrationContext.configure(connection).get_current_revision()
    known = {script.revision for script in scripts.walk_revisions()}
    if current is not None and current not in known:
        raise DatabaseTooNew(
            f"The database is at revision {current!r}, which this version of Accord does not know: a newer one has "
            "migrated it. Start that version, or choose another database with ACCORD_HOME or ACCORD_DATABASE_URL."
        )
    if current != scripts.get_current_head():
        command.upgrade(settings, "head")
