"""The statements of the label path find what they look for by an index, however many queries there are."""

from typing import Any

from sqlalchemy import event

from accord.domain.enums import Role
from accord.services import accounts, label, lease
from support.sample_experiments import create_sample, user
from support.stores import Stores


def statements_of_a_round_trip(stores: Stores) -> list[tuple[str, Any]]:
    """SQL and values of everything that one `next` and one label run."""
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


def test_no_statement_of_a_round_trip_reads_a_whole_table_or_all_open_queries(sqlite: Stores) -> None:
    statements = statements_of_a_round_trip(sqlite)
    assert len(statements) >= 8
    with sqlite.database.reading() as session:
        for sql, values in statements:
            rows = session.connection().exec_driver_sql(
                f"EXPLAIN QUERY PLAN {sql}", values[0] if isinstance(values, list) else values
            )
            plan = [str(row[3]) for row in rows]
            assert not [step for step in plan if step.startswith("SCAN")], (sql, plan)
            # a lease is found by its holder, not among all that are open
            if "leased_by = ?" in sql and sql.startswith("SELECT"):
                assert any("ix_queries_leased" in step for step in plan), plan
            # and what is sorted first has to be read whole
            if "LIMIT" in sql:
                assert not [step for step in plan if "TEMP B-TREE" in step], (sql, plan)
