"""Runs the migrations on the connection that `accord.store.migrate` hands over."""

from typing import Any, Literal

from alembic import context

from accord.store.tables import Base, UtcDateTime


def render_item(kind: str, item: Any, _autogenerate_context: Any) -> str | Literal[False]:
    """Writes a column's type into a new script as it is in the database, so that old scripts never import our code."""
    if kind == "type" and isinstance(item, UtcDateTime):
        return "sa.DateTime(timezone=True)"
    return False


context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    render_item=render_item,
    # SQLite alters a table by copying it
    render_as_batch=True,
)
# the caller holds the transaction
context.run_migrations()
