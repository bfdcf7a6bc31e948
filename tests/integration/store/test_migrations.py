"""Migrations: equality with the tables of the code, repetition, reversal and concurrency."""

import re
import threading
from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import inspect, text

from accord import store
from accord.domain.errors import DatabaseTooNew
from accord.store.database import Database, alembic_config
from accord.store.tables import Base
from support.stores import Stores


def test_migrated_tables_equal_the_tables_of_the_code(stores: Stores) -> None:
    with stores.database.reading() as session:
        context = MigrationContext.configure(session.connection())
        assert compare_metadata(context, Base.metadata) == []


def test_migrating_again_changes_nothing(stores: Stores) -> None:
    with stores.database.transaction() as session:
        session.execute(text("INSERT INTO claims VALUES ('subject', 'holder', '2030-01-01')"))
    stores.database.migrate()
    with stores.database.reading() as session:
        assert session.execute(text("SELECT count(*) FROM claims")).scalar_one() == 1


def test_migrations_can_be_reverted_and_repeated(stores: Stores) -> None:
    with stores.database.engine.begin() as connection:
        command.downgrade(alembic_config(connection), "base")
    assert inspect(stores.database.engine).get_table_names() == ["alembic_version"]
    stores.database.migrate()
    with stores.database.reading() as session:
        assert compare_metadata(MigrationContext.configure(session.connection()), Base.metadata) == []


def test_database_of_a_newer_version_is_refused(stores: Stores) -> None:
    with stores.database.transaction() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(DatabaseTooNew):
        stores.database.migrate()


def test_concurrent_migrations_succeed(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'accord.db'}"
    errors: list[BaseException] = []
    barrier = threading.Barrier(4)

    def start() -> None:
        database = Database.open(url)
        try:
            barrier.wait()
            database.migrate()
        except BaseException as error:  # noqa: BLE001
            errors.append(error)
        finally:
            database.close()

    threads = [threading.Thread(target=start) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


def test_every_migration_has_a_docstring() -> None:
    scripts = list((Path(store.__file__).parent / "migrations" / "versions").glob("[0-9]*.py"))
    assert scripts
    for script in scripts:
        assert re.match(r'"""\w.+\."""', script.read_text()), script.name
