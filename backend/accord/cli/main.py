"""The command `accord`: its subcommands, and how errors end it."""

import sys

from pydantic import ValidationError

from accord.domain.errors import AccordError
from mapt.cli.app import LazyCommand, make_app, run_app
from mapt.cli.output import print_error
from mapt.errors import MaptError

app = make_app(
    "accord",
    "Label pairs of clips in the browser and train multi-agent policies on the preferences.",
    {
        "up": LazyCommand("accord.cli.up", "up", "Start the service: web page, API and workers."),
        "workers": LazyCommand(
            "accord.cli.up", "workers", "Start only workers, on a further host or on a Ray cluster."
        ),
        "link": LazyCommand("accord.cli.accounts", "link", "Print a new sign-in link for the admin."),
        "user": LazyCommand("accord.cli.accounts", "user", "Manage users and their sign-in links."),
        "start": LazyCommand("accord.cli.start", "start", "Start experiments from a file."),
        "teach": LazyCommand("accord.cli.teach", "teach", "Label an experiment with a scripted teacher."),
        "demo": LazyCommand("accord.cli.demo", "demo", "Train policies from a scripted teacher's labels."),
        "tasks": LazyCommand("mapt.cli.tasks", "tasks", "List the tasks."),
        "export": LazyCommand(
            "accord.cli.export", "export", "Export an experiment as Parquet tables, or for other programs."
        ),
        "import": LazyCommand(
            "accord.cli.importing",
            "import_experiment",
            "Import an exported experiment, or segments and labels of another program.",
        ),
        "push": LazyCommand("accord.cli.push", "push", "Upload a reward version to the Hugging Face Hub."),
        "verify": LazyCommand("accord.cli.verify", "verify", "Check that the database and the blobs are complete."),
        "backup": LazyCommand("accord.cli.backup", "backup", "Write a backup of the database and the blobs."),
        "restore": LazyCommand("accord.cli.backup", "restore", "Restore a backup into a new home folder."),
        "prune": LazyCommand("accord.cli.prune", "prune", "Show or delete what nothing needs any more."),
        "doctor": LazyCommand("accord.cli.doctor", "doctor", "Check that this machine can run Accord."),
    },
)


def main() -> None:
    """Entry point of the script `accord`."""
    try:
        run_app(app, "accord", (AccordError, MaptError))
    except ValidationError as error:
        for problem in error.errors():
            setting = "_".join(["ACCORD", *(str(part).upper() for part in problem["loc"])])
            print_error(f"{setting}: {problem['msg']}.", program="accord")
        sys.exit(2)
