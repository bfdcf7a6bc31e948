"""accord export: an experiment as Parquet tables."""

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from sqlalchemy.engine import make_url

from accord.cli.options import Home, load_settings
from accord.cli.output import out, say
from accord.domain.errors import Unavailable
from accord.services.export import contents, write
from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database


def export(
    *,
    experiment: Annotated[str, typer.Option(help="Id of the experiment, exp_...")],
    output: Annotated[Path, typer.Option(help="New folder for segments, queries and labels.")],
    home: Home = None,
) -> None:
    """Write an experiment's segments, queries and labels as Parquet tables. A service may go on running."""
    settings = load_settings(home)
    database = _open_existing(settings)
    try:
        with database.reading() as session:
            found = contents(session, experiment)
    finally:
        database.close()
    columns = (TextColumn("segments"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=out) as progress:
        bar = progress.add_task("segments", total=len(found.segments))
        write(
            open_blobs(settings.resolved_blob_url),
            found,
            output,
            lambda count: progress.update(bar, completed=count),
        )
    skips = sum(label.state == "skip" for label in found.labels)
    counts = f"{len(found.segments)} segments, {len(found.queries)} queries, {len(found.labels) - skips} labels"
    say(f"{counts} and {skips} skips are in {output}.")


def _open_existing(settings: Settings) -> Database:
    """The database as it is: an export makes none, and changes none.

    Raises:
        Unavailable: if there is none.
    """
    url = make_url(settings.resolved_database_url)
    if url.get_backend_name() == "sqlite" and url.database and not Path(url.database).exists():
        raise Unavailable(f"There is no database at {url.database}. Give the folder of the service with --home.")
    return Database.open(settings.resolved_database_url)
