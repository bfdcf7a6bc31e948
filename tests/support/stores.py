"""Migrated databases and blobs for tests: SQLite in a folder, and a Postgres of our own where one is installed."""

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import create_engine, text

from accord.store.blobs import BlobStore, open_blobs
from accord.store.database import Database
from support.ports import free_port

POSTGRES_BIN = Path("/usr/lib/postgresql/15/bin")


@dataclass(frozen=True, slots=True)
class Stores:
    """A migrated database and empty blobs."""

    database: Database
    blobs: BlobStore
    database_url: str
    blob_url: str


@contextmanager
def stores(home: Path, database_url: str = "") -> Generator[Stores]:
    """Stores in a folder; SQLite unless another database is given."""
    url = database_url or f"sqlite:///{home / 'accord.db'}"
    blob_url = f"file://{home / 'blobs'}"
    database = Database.open(url)
    try:
        database.migrate()
        yield Stores(database, open_blobs(blob_url), url, blob_url)
    finally:
        database.close()


def missing_for_postgres() -> str:
    """What keeps a Postgres from being started here; empty when nothing does."""
    if not (POSTGRES_BIN / "initdb").exists():
        return f"no PostgreSQL 15 in {POSTGRES_BIN}"
    try:
        import psycopg  # noqa: F401
    except ImportError:
        return "psycopg is not installed: pip install 'accord[postgres]'"
    if os.getuid() == 0:
        try:
            pwd.getpwnam("postgres")
        except KeyError:
            return "there is no user postgres, and Postgres does not run as root"
    return ""


@contextmanager
def postgres() -> Generator[str]:
    """The URL of a fresh Postgres server of our own, stopped and removed with the block."""
    folder = Path(tempfile.mkdtemp(prefix="accord-postgres-", dir="/tmp"))
    identity: dict[str, str] = {}
    if os.getuid() == 0:
        shutil.chown(folder, "postgres")
        identity = {"user": "postgres"}
    data = folder / "data"

    def run(program: str, *arguments: str) -> None:
        subprocess.run(
            [POSTGRES_BIN / program, *arguments], check=True, stdout=subprocess.DEVNULL, cwd=folder, **identity
        )

    port = free_port()
    try:
        run("initdb", "-D", str(data), "-A", "trust", "-U", "accord", "--no-sync", "-E", "UTF8")
        options = f"-p {port} -k {folder} -h 127.0.0.1 -c fsync=off"
        run("pg_ctl", "-D", str(data), "-o", options, "-l", str(folder / "log"), "-w", "start")
        try:
            yield f"postgresql+psycopg://accord@127.0.0.1:{port}/postgres"
        finally:
            run("pg_ctl", "-D", str(data), "-m", "immediate", "-w", "stop")
    finally:
        shutil.rmtree(folder)


@contextmanager
def empty_postgres_database(server_url: str, name: str) -> Generator[str]:
    """A database of its own on a running server."""
    engine = create_engine(server_url, isolation_level="AUTOCOMMIT")
    try:
        with engine.connect() as connection:
            connection.execute(text(f'CREATE DATABASE "{name}"'))
            yield f"{server_url.rpartition('/')[0]}/{name}"
            connection.execute(text(f'DROP DATABASE "{name}" WITH (FORCE)'))
    finally:
        engine.dispose()
