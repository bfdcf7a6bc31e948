"""The subcommand `accord verify`."""

from contextlib import closing
from typing import Annotated

import typer

from accord.cli.checks import blob_progress, finish
from accord.cli.options import Home, load_settings, open_existing
from accord.services.verification import verify as verify_stores
from accord.store.blobs import open_blobs
from accord.store.migrate import require_current
from mapt.cli.options import Json


def verify(
    *,
    home: Home = None,
    quick: Annotated[bool, typer.Option(help="Check only that blobs exist, without reading them.")] = False,
    as_json: Json = False,
) -> None:
    """Check that the database and the blobs are complete.

    Checks the database's file, that every label agrees with its history and every reward version with its labels, and
    that every blob that a row names exists and is complete. Changes nothing, and the service may keep running. Exits
    with status 1 if a check fails.
    """
    settings = load_settings(home)
    with closing(open_existing(settings)) as database, blob_progress(hidden=as_json) as on_blobs:
        require_current(database)
        blobs = open_blobs(settings.resolved_blob_url)
        checks = verify_stores(database, blobs, read_blobs=not quick, on_blobs=on_blobs)
    finish(checks, as_json=as_json)
