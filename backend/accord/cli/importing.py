"""The subcommand `accord import`."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from accord.cli.options import Home, load_settings
from accord.services import accounts, experiments, importing
from accord.store.blobs import open_blobs
from accord.store.database import Database
from accord.store.migrate import migrate
from mapt.cli.options import Json
from mapt.cli.output import ProgressBars, print_json, print_line
from mapt.preferences.formats.tables import PreferenceTables


def import_experiment(
    folder: Annotated[Path, typer.Argument(help="Folder that `accord export` wrote.")],
    *,
    name: Annotated[str, typer.Option(help="Name of the new experiment.")],
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Import an exported experiment.

    Creates a paused experiment with the settings, the segments and the labels of the export. Resume it on its page: a
    new policy then trains on the labels, without anyone giving them again. The service may keep running.
    """
    settings = load_settings(home)
    tables = PreferenceTables.open(folder)
    with closing(Database.open(settings.resolved_database_url)) as database:
        migrate(database)
        # before the arrays are stored, which takes a while and which no row would refer to
        with database.reading() as session:
            experiments.require_unused_name(session, name)
        with ProgressBars(hidden=as_json) as bars:
            bars.add("segments", "segments", tables.n_segments)
            storing = importing.storing(
                open_blobs(settings.resolved_blob_url),
                tables,
                lambda count: bars.update("segments", count, f"{count}/{tables.n_segments}"),
            )
            with storing as found, database.transaction() as session:
                importing.create(session, accounts.ensure_admin(session).id, name, found)
    counts = {
        "segments": len(found.segments),
        "queries": len(found.queries),
        "labels": sum(label.state == "label" for label in found.labels),
    }
    if as_json:
        print_json({"experiment": found.experiment_id} | counts)
    else:
        listed = ", ".join(f"{count} {what}" for what, count in counts.items())
        print_line(f"{listed} imported as {found.experiment_id}, which is paused.")
