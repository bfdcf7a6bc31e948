"""Commands put together, and what a failure looks like: one sentence, status 2, no traceback."""

import sys

import typer
from pydantic import ValidationError

from accord.cli import accounts, demo, doctor, export, tasks, teach, up
from accord.cli.output import complain
from accord.domain.errors import AccordError

app = typer.Typer(
    name="accord",
    help="Teach teams of agents by comparing short clips.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command("up")(up.up)
app.command("link")(accounts.link)
app.command("teach")(teach.teach)
app.command("demo")(demo.demo)
app.command("tasks")(tasks.tasks)
app.command("export")(export.export)
app.command("doctor")(doctor.doctor)
app.add_typer(accounts.user, name="user")


def main() -> None:
    """The entry point of the script `accord`."""
    try:
        app()
    except AccordError as error:
        complain(str(error))
        sys.exit(2)
    except ValidationError as error:
        for problem in error.errors():
            setting = "_".join(["ACCORD", *(str(part).upper() for part in problem["loc"])])
            complain(f"{setting}: {problem['msg']}.")
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
