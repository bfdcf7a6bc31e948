"""The SQL statements that lease and label a query use indexes."""

from typing import Any

from sqlalchemy import event

from accord.domain.enums import Role
from accord.services import accounts, label, lease
from support.sample_experiments import create_sample, user
from support.stores import Stores


def statements_of_lease_and_label(stores: Stores) -> list[tuple[str, Any]]:
    """SQL and values of the statements that lease and label one query."""
    sample = create_sample(stores.database, stores.blobs)
    with stores.database.transaction() as session:
        _, token = user(session, "ada", Role.LABELLER)
    found: list[tuple[str, Any]] = []
    event.listen(
        stores.database.engine, "before_cursor_execute", lambda *args: found.append((args[2], args[3])), named=False
    )
    with stores.database.transaction() as session:
        ada = accounts.authenticate(session, token)
        (query,) = lease.next_queries(session, ada, sample.experiment.id, 1, 60.0).items
        label.put_label(session, ada, query.id, 1.0, "shown")
    return [each for each in found if each[0].startswith(("SELECT", "UPDATE"))]


def test_no_statement_scans_a_table_or_sorts_all_open_queries(sqlite: Stores) -> None:
    statements = statements_of_lease_and_label(sqlite)
    assert len(statements) >= 8
    with sqlite.database.reading() as session:
        for sql, values in statements:
            rows = session.connection().exec_driver_sql(
                f"EXPLAIN QUERY PLAN {sql}", values[0] if isinstance(values, list) else values
            )
            plan = [str(row[3]) for row in rows]
            assert not [step for step in plan if step.startswith("SCAN")], (sql, plan)
            # Leases are found by their holder, not among all open queries.
            if "leased_by = ?" in sql and sql.startswith("SELECT"):
                assert any("ix_queries_leased" in step for step in plan), plan
            # A temporary B-tree would sort all rows before the limit applies.
            if "LIMIT" in sql:
                assert not [step for step in plan if "TEMP B-TREE" in step], (sql, plan)
