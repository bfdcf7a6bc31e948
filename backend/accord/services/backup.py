"""Backups: a folder with a copy of the database and of the blobs that it names, made while the service runs.

The database is copied first. Blobs never change, and while they are copied none is deleted, so that the backup is
consistent. `checksums.sha256` has the format of `sha256sum --check`.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Generator, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from accord.domain.checks import Check
from accord.domain.errors import BlobMissing, Invalid, Unavailable
from accord.services import blob_deletion, inventory
from accord.services.verification import verify_blobs, verify_copies, verify_file, verify_rows
from accord.store import database_copy
from accord.store.blobs import BlobStore, FolderBlobs, OnBlobs, open_blobs
from accord.store.database import Database, sqlite_file
from accord.store.migrate import is_current, require_known, revision
from accord.store.tables import utc_now
from mapt.io import sync_folder

FORMAT: Final = 1
_MANIFEST: Final = "backup.json"
_CHECKSUMS: Final = "checksums.sha256"
_BLOBS: Final = "blobs"


class BackupDamaged(Unavailable):
    """A file of a backup is missing or was changed."""

    code = "backup_damaged"

    def __init__(self, file: Path, fault: str) -> None:
        super().__init__(f"The backup is damaged: {file} {fault}. Use another backup.")


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a backup holds."""

    #: version of Accord that made it
    accord: str
    created_at: str
    #: name of the copy of the database
    database: str
    database_bytes: int
    #: of the tables; None for a database without tables
    revision: str | None
    blobs: int
    blob_bytes: int
    #: SHA-256 of the file of checksums
    checksums: str
    format: int = FORMAT


@dataclass(frozen=True, slots=True)
class Backup:
    """A backup that was written, and what its verification found."""

    manifest: Manifest
    checks: list[Check]


def back_up(
    database: Database, blobs: BlobStore, folder: Path, on_blobs: OnBlobs = lambda _done, _total: None
) -> Backup:
    """Writes a backup into a new folder and verifies it. The service may keep running.

    Everything that was committed before is in it. Blobs that are missing or damaged already fail a check.

    Raises:
        Invalid: if `folder` exists.
        BlobsInUse: if another backup runs.
        DatabaseUnreachable, DatabaseNotCopied: if the database cannot be read.
        Unavailable: if the database is damaged, or the folder cannot be written. Nothing is left behind.
    """
    if folder.exists():
        raise Invalid(f"{folder} already exists. Choose a new folder for the backup.")
    try:
        with blob_deletion.suspended(database, "accord backup"), _renamed_at_end(folder) as partial:
            return _write(database, blobs, partial, on_blobs)
    except OSError as error:
        raise Unavailable(f"{folder} cannot be written: {error.strerror}. Choose another folder.") from error


def _write(database: Database, blobs: BlobStore, folder: Path, on_blobs: OnBlobs) -> Backup:
    stored = {blob.key for blob in blobs.stored()}
    with database_copy.copied(database, folder) as session:
        file = verify_file(session)
        if not file.ok:
            raise Unavailable(f"The database {database.name} is damaged: {file.detail}. Use an earlier backup.")
        required = inventory.required(session)
        keys = {blob.key for blob in required} | (inventory.optional_keys(required) & stored)
        copies = FolderBlobs(folder / _BLOBS)
        checksums = _copy_blobs(blobs, sorted(keys), folder / _BLOBS, on_blobs)
        checks = [file, *(verify_rows(session) if is_current(database) else []), verify_copies(copies, required)]
    copy = folder / database_copy.file_name(database)
    checksums[copy.name] = _sha256(copy)
    lines = "".join(f"{checksum}  {name}\n" for name, checksum in checksums.items()).encode()
    (folder / _CHECKSUMS).write_bytes(lines)
    manifest = Manifest(
        accord=version("accord"),
        created_at=utc_now().isoformat(),
        database=copy.name,
        database_bytes=copy.stat().st_size,
        revision=revision(database),
        blobs=len(checksums) - 1,
        blob_bytes=sum(blob.size_bytes for blob in copies.stored()),
        checksums=hashlib.sha256(lines).hexdigest(),
    )
    (folder / _MANIFEST).write_text(json.dumps(asdict(manifest), indent=2) + "\n")
    return Backup(manifest, checks)


def _copy_blobs(blobs: BlobStore, keys: list[str], folder: Path, on_blobs: OnBlobs) -> dict[str, str]:
    """Copies the blobs that exist. Returns file -> checksum, relative to the backup."""
    checksums: dict[str, str] = {}
    for done, key in enumerate(keys, 1):
        try:
            content = blobs.read(key)
        except BlobMissing:
            continue
        path = folder / key
        path.parent.mkdir(parents=True, exist_ok=True)
        # Not flushed one by one, which takes longer than all the rest; see `_renamed_at_end`.
        path.write_bytes(content)
        checksums[f"{_BLOBS}/{key}"] = hashlib.sha256(content).hexdigest()
        on_blobs(done, len(keys))
    return checksums


@contextmanager
def _renamed_at_end(folder: Path) -> Generator[Path]:
    """A folder that gets its name once it is complete and on disk; it is deleted if the block raises."""
    partial = folder.absolute().with_name(f".{folder.name}.partial")
    # of a backup that was killed; there is no other one at the same time
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        os.sync()
        partial.rename(folder)
        sync_folder(partial.parent)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def read_manifest(folder: Path) -> Manifest:
    """
    Raises:
        Invalid: if the folder is not a backup, or was made by a later version of Accord.
    """
    try:
        found: dict[str, Any] = json.loads((folder / _MANIFEST).read_text())
        if found["format"] > FORMAT:
            raise Invalid(f"A later version of Accord ({found['accord']}) made the backup {folder}. Use that version.")
        return Manifest(**found)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Invalid(f"{folder} is not a backup: it has no complete {_MANIFEST}.") from error


def restore(
    folder: Path, database_url: str, blob_url: str, on_blobs: OnBlobs = lambda _done, _total: None
) -> list[Check]:
    """Restores a backup into a new database and an empty blob store, and verifies them.

    Raises:
        Invalid: if the folder is not a backup, or one of another kind of database; or if the blob store is not empty.
        DatabaseTooNew: if a later version of Accord made it.
        BackupDamaged: if a file of it is missing or was changed.
        DatabaseNotEmpty: if the database exists, or has tables.
        DatabaseNotCopied, BlobsNotWritable, Unavailable: if the copies cannot be written.
    """
    manifest = read_manifest(folder)
    checksums = _read_checksums(folder, manifest)
    if (sqlite_file(database_url) is None) == manifest.database.endswith(".db"):
        kind = "SQLite" if manifest.database.endswith(".db") else "PostgreSQL"
        raise Invalid(f"The backup {folder} is of a {kind} database. Set ACCORD_DATABASE_URL to one, or unset it.")
    require_known(manifest.revision)
    database_copy.require_new(database_url)
    blobs = open_blobs(blob_url)
    if not blobs.is_empty():
        raise Invalid(f"{blob_url} holds blobs already. Restore into another, empty store.")
    copy = folder / manifest.database
    if _sha256(copy) != checksums.pop(manifest.database, None):
        raise BackupDamaged(copy, "does not have its checksum")
    # The database comes last, so that an interrupted restore has none, and is not taken for a complete one.
    blobs.put_many(_contents(folder, checksums, on_blobs))
    try:
        database_copy.restore(copy, database_url)
    except OSError as error:
        raise Unavailable(f"The database cannot be written: {error.strerror}.") from error
    with closing(Database.open(database_url)) as database:
        current = is_current(database)
        with database.reading() as session:
            checks = [verify_file(session), *(verify_rows(session) if current else [])]
        return checks + verify_blobs(database, blobs, read_blobs=False)


def _contents(folder: Path, checksums: Mapping[str, str], on_blobs: OnBlobs) -> Iterator[tuple[str, bytes]]:
    """Key and content of the blobs of a backup. Raises BackupDamaged."""
    copies = FolderBlobs(folder / _BLOBS)
    for done, (name, checksum) in enumerate(checksums.items(), 1):
        key = name.removeprefix(f"{_BLOBS}/")
        try:
            content = copies.read(key)
        except (BlobMissing, ValueError) as error:
            raise BackupDamaged(folder / name, "is missing") from error
        if hashlib.sha256(content).hexdigest() != checksum:
            raise BackupDamaged(folder / name, "does not have its checksum")
        yield key, content
        on_blobs(done, len(checksums))


def _read_checksums(folder: Path, manifest: Manifest) -> dict[str, str]:
    """File -> checksum."""
    path = folder / _CHECKSUMS
    if _sha256(path) != manifest.checksums:
        raise BackupDamaged(path, "does not have its checksum")
    return {name: checksum for checksum, _, name in (line.partition("  ") for line in path.read_text().splitlines())}


def _sha256(path: Path) -> str:
    """Raises BackupDamaged if there is no such file."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError as error:
        raise BackupDamaged(path, "is missing") from error
