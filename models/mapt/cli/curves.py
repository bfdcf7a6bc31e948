"""mapt curves: runs beside each other."""

from pathlib import Path
from typing import Annotated

import typer

from mapt.cli.output import say
from mapt.studies.naming import numbers
from mapt.training.curves import draw_curves
from mapt.training.results import RunResult, find_runs, grouped, markdown


def curves(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs, or folders that hold such.")],
    *,
    output: Annotated[Path, typer.Option(help="The picture, as png, pdf or svg.")],
    table: Annotated[Path | None, typer.Option(help="Markdown table to write beside it.")] = None,
    steps: Annotated[
        str | None,
        typer.Option(
            help="Steps that the table tells of, with commas between; `--evaluate-every` of `mapt train` makes them.  "
            "[default: the last evaluation]"
        ),
    ] = None,
) -> None:
    """Draw true return over steps, mean and spread over seeds, for each task, algorithm and reward."""
    milestones = numbers("--steps", steps, 1) if steps else ()
    groups = grouped([RunResult.read(folder) for folder in find_runs(runs)])
    output.parent.mkdir(parents=True, exist_ok=True)
    draw_curves(groups, output)
    say(f"[dim]{output}[/dim]")
    if table is not None:
        table.parent.mkdir(parents=True, exist_ok=True)
        table.write_text(markdown(groups, milestones))
        say(f"[dim]{table}[/dim]")
