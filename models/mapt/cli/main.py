"""Commands put together, and what a failure looks like: one sentence, status 2, no traceback."""

import sys

import typer

from mapt.cli import benchmarks, results, tasks, train
from mapt.cli.output import complain
from mapt.errors import MaptError

app = typer.Typer(
    name="mapt",
    help="Learn rewards of teams of agents from preferences, train policies, and see how good they are.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command("tasks")(tasks.tasks)
app.command("train")(train.train)
app.command("evaluate")(results.evaluate)
app.command("curves")(results.curves)
app.command("dataset")(benchmarks.dataset)
app.command("table")(benchmarks.table)
app.command("report")(benchmarks.report)


def main() -> None:
    """The entry point of the script `mapt`."""
    try:
        app()
    except MaptError as error:
        complain(str(error))
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
