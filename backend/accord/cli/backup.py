"""The subcommands `accord backup` and `accord restore`."""

from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from accord.cli.checks import print_check
from accord.cli.options import Home, load_settings, open_existing
from accord.domain.errors import Invalid
from accord.services.backup import back_up, read_manifest
from accord.services.backup import restore as restore_backup
from accord.store.blobs import open_blobs
from accord.store.home import keep_new_files_private
from mapt.cli.options import Json
from mapt.cli.output import ProgressBars, print_json, print_line


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
    with closing(open_existing(settings)) as database, ProgressBars(hidden=as_json) as bars:
        bars.add("blobs", "blobs", 1)
        made = back_up(
            database,
            open_blobs(settings.resolved_blob_url),
            folder,
            lambda done, total: bars.update("blobs", done / total, f"{done}/{total}"),
        )
    if as_json:
        print_json(asdict(made.manifest) | {"checks": [asdict(check) for check in made.checks]})
    else:
        for check in made.checks:
            print_check(check)
        print_line(
            f"{made.manifest.blobs} blobs ({made.manifest.blob_bytes / 1e6:.1f} MB) and a database "
            f"({made.manifest.database_bytes / 1e6:.1f} MB) written to {folder}."
        )
    raise typer.Exit(0 if all(check.ok for check in made.checks) else 1)


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
    with ProgressBars(hidden=as_json) as bars:
        bars.add("blobs", "blobs", 1)
        checks = restore_backup(
            folder,
            settings.resolved_database_url,
            settings.resolved_blob_url,
            lambda done, total: bars.update("blobs", done / total, f"{done}/{total}"),
        )
    if as_json:
        print_json(asdict(manifest) | {"checks": [asdict(check) for check in checks]})
    else:
        for check in checks:
            print_check(check)
        print_line(f"The backup of {manifest.created_at} is restored. Start it: accord up --home {settings.home}")
    raise typer.Exit(0 if all(check.ok for check in checks) else 1)
