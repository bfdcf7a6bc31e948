"""Commands put together, and what a failure looks like: one sentence, status 2, no traceback."""

import sys

import typer

from mapt.benchmarks.errors import StudyError
from mapt.cli import benchmarks, results, tasks, train
from mapt.cli.output import complain
from mapt.policies import PolicyError
from mapt.preferences.errors import PreferenceError
from mapt.rendering.errors import RenderingError
from mapt.rewards.errors import RewardModelError
from mapt.tasks import TaskError
from mapt.training.errors import RunError

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
    except (StudyError, RunError, TaskError, PreferenceError, RewardModelError, PolicyError, RenderingError) as error:
        complain(str(error))
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
