"""Migrated databases and blob stores for tests, on SQLite and on a PostgreSQL server that the tests start."""

import os
import pwd
import secrets
import shutil
import subprocess
import tempfile
from collections.abc import Generator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from sqlalchemy import create_engine, text

from accord.store.blobs import BlobStore, open_blobs
from accord.store.database import Database
from accord.store.migrate import migrate
from support.ports import free_port

#: where Debian and Ubuntu install a major version's server programs, which are not in PATH
POSTGRES_VERSIONS = Path("/usr/lib/postgresql")
_MIGRATED = "migrated"


@dataclass(frozen=True, slots=True)
class Stores:
    """A migrated database and empty blobs."""

    database: Database
    blobs: BlobStore
    database_url: str
    blob_url: str


@contextmanager
def open_stores(home: Path, database_url: str = "", blob_url: str = "") -> Generator[Stores]:
    """A migrated SQLite database and blobs in a folder, unless a URL names others; the database is migrated then."""
    url = database_url or f"sqlite:///{home / 'accord.db'}"
    blob_url = blob_url or f"file://{home / 'blobs'}"
    if not database_url:
        home.mkdir(parents=True, exist_ok=True)
        (home / "accord.db").write_bytes(_migrated_sqlite())
    with closing(Database.open(url)) as database:
        yield Stores(database, open_blobs(blob_url), url, blob_url)


@cache
def _migrated_sqlite() -> bytes:
    """The file of a migrated database, because a copy takes a tenth of the time of the migrations."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "accord.db"
        with closing(Database.open(f"sqlite:///{path}")) as database:
            migrate(database)
        return path.read_bytes()


def postgres_programs() -> Path | None:
    """The folder of `initdb` and `pg_ctl`: Debian's newest version, else that of PATH, else None."""
    versions = [folder for folder in POSTGRES_VERSIONS.glob("*/bin") if (folder / "initdb").is_file()]
    if versions:
        return max(versions, key=lambda folder: float(folder.parent.name))
    found = shutil.which("initdb")
    return Path(found).resolve().parent if found else None


def missing_for_postgres() -> str:
    """Explain why this machine cannot start a PostgreSQL server; empty if it can."""
    if postgres_programs() is None:
        return (
            f"PostgreSQL is not installed: no initdb in {POSTGRES_VERSIONS}/*/bin or PATH. "
            "Run .ci/system-packages test, or apt-get install postgresql"
        )
    if find_spec("psycopg") is None:
        return "psycopg is not installed: pip install 'accord[postgres]'"
    if os.getuid() == 0:
        try:
            pwd.getpwnam("postgres")
        except KeyError:
            return "There is no user postgres, and PostgreSQL refuses to run as root"
    return ""


class PostgresServer:
    """A PostgreSQL server with a migrated database as template. It is removed at the end of the block."""

    def __init__(self, *, durable: bool = False) -> None:
        """
        Args:
            durable: whether it writes to the disk before it acknowledges a commit, as outside tests.
        """
        programs = postgres_programs()
        assert programs is not None
        self._programs = programs
        self._folder = Path(tempfile.mkdtemp(prefix="accord-postgres-", dir="/tmp"))
        self._identity: dict[str, str] = {}
        if os.getuid() == 0:
            shutil.chown(self._folder, "postgres")
            self._identity = {"user": "postgres"}
        port = free_port()
        fsync = "on" if durable else "off"
        self._options = f"-p {port} -k {self._folder} -h 127.0.0.1 -c fsync={fsync}"
        self.url = f"postgresql+psycopg://accord@127.0.0.1:{port}/postgres"

    def __enter__(self) -> "PostgresServer":
        self._run("initdb", "-A", "trust", "-U", "accord", "--no-sync", "-E", "UTF8")
        self.start()
        _execute(self.url, f"CREATE DATABASE {_MIGRATED}")
        with closing(Database.open(_beside(self.url, _MIGRATED))) as database:
            migrate(database)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        shutil.rmtree(self._folder)

    def start(self) -> None:
        """Start it, again after `stop` with the same databases."""
        self._run("pg_ctl", "-o", self._options, "-l", str(self._folder / "log"), "-w", "start")

    def stop(self) -> None:
        """Stop it at once: connections break, and nobody can connect."""
        self._run("pg_ctl", "-m", "immediate", "-w", "stop")

    def _run(self, program: str, *arguments: str) -> None:
        command = [self._programs / program, "-D", str(self._folder / "data"), *arguments]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=self._folder, **self._identity)


@contextmanager
def migrated_postgres_database(server_url: str, name: str) -> Generator[str]:
    """Create a migrated database on a PostgreSQL server, yield its URL and drop it afterwards."""
    _execute(server_url, f'CREATE DATABASE "{name}" TEMPLATE {_MIGRATED}')
    yield _beside(server_url, name)
    _execute(server_url, f'DROP DATABASE "{name}" WITH (FORCE)')


@contextmanager
def new_database_url(stores: Stores, folder: Path) -> Generator[str]:
    """The URL of a database without tables: SQLite in a folder or PostgreSQL, as the stores."""
    if stores.database.is_sqlite:
        yield f"sqlite:///{folder / 'accord.db'}"
        return
    name = f"new_{secrets.token_hex(6)}"
    server = _beside(stores.database_url, "postgres")
    _execute(server, f'CREATE DATABASE "{name}"')
    yield _beside(server, name)
    _execute(server, f'DROP DATABASE "{name}" WITH (FORCE)')


def _execute(url: str, statement: str) -> None:
    engine = create_engine(url, isolation_level="AUTOCOMMIT")
    try:
        with engine.connect() as connection:
            connection.execute(text(statement))
    finally:
        engine.dispose()


def _beside(url: str, name: str) -> str:
    """The URL of another database on the same server."""
    return f"{url.rpartition('/')[0]}/{name}"
