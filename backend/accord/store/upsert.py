"""INSERT ... ON CONFLICT, which SQLAlchemy spells per database."""

from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from accord.store.tables import Base


def insert(session: Session, table: type[Base]) -> sqlite.Insert | postgresql.Insert:
    """An INSERT that knows on_conflict_do_nothing and on_conflict_do_update."""
    if session.get_bind().dialect.name == "postgresql":
        return postgresql.insert(table)
    return sqlite.insert(table)
