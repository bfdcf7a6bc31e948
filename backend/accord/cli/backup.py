"""The subcommands `accord backup` and `accord restore`."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from accord.cli.checks import blob_progress, print_check
from accord.cli.options import Home, load_settings, open_existing
from accord.domain.checks import Check
from accord.domain.errors import Invalid
from accord.services.backup import Manifest, back_up, read_manifest
from accord.services.backup import restore as restore_backup
from accord.store.blobs import open_blobs
from accord.store.home import keep_new_files_private
from mapt.cli.options import Json
from mapt.cli.output import print_json, print_line


def backup(
    folder: Annotated[Path, typer.Argument(help="Folder for the backup; it must not exist.")],
    *,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Write a backup of the database and the blobs.

    The service may keep running: everything that it acknowledged before is in the backup. Verifies the backup, and
    exits with status 1 if a check fails, for example because a blob was missing already.
    """
    keep_new_files_private()
    settings = load_settings(home)
    with closing(open_existing(settings)) as database, blob_progress(hidden=as_json) as on_blobs:
        made = back_up(database, open_blobs(settings.resolved_blob_url), folder, on_blobs)
    done = (
        f"{made.manifest.blobs} blobs ({made.manifest.blob_bytes / 1e6:.1f} MB) and a database "
        f"({made.manifest.database_bytes / 1e6:.1f} MB) written to {folder}."
    )
    _finish(made.manifest, made.checks, done, as_json=as_json)


def restore(
    folder: Annotated[Path, typer.Argument(help="Folder that `accord backup` wrote.")],
    *,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Restore a backup into a new home folder.

    The home folder must be empty or not exist. Compares every file with its checksum, and verifies the result.
    Experiments that ran continue when `accord up` starts.
    """
    keep_new_files_private()
    settings = load_settings(home)
    if settings.home.exists() and any(settings.home.iterdir()):
        raise Invalid(
            f"The home folder {settings.home} is not empty. Choose another with --home. If an interrupted restore left "
            "it, delete it and try again."
        )
    manifest = read_manifest(folder)
    with blob_progress(hidden=as_json) as on_blobs:
        checks = restore_backup(folder, settings.resolved_database_url, settings.resolved_blob_url, on_blobs)
    done = f"The backup of {manifest.created_at} is restored. Start it: accord up --home {settings.home}"
    _finish(manifest, checks, done, as_json=as_json)


def _finish(manifest: Manifest, checks: Sequence[Check], done: str, *, as_json: bool) -> NoReturn:
    """Print the backup and its checks, and end the command, with status 1 if one failed."""
    if as_json:
        print_json(asdict(manifest) | {"checks": [asdict(check) for check in checks]})
    else:
        for check in checks:
            print_check(check)
        print_line(done)
    raise typer.Exit(0 if all(check.ok for check in checks) else 1)
