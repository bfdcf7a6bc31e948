"""The `mapt` command and its subcommands."""

from mapt.cli.app import LazyCommand, make_app, run_app
from mapt.errors import MaptError

app = make_app(
    "mapt",
    "Train multi-agent policies and preference-based reward models, and compare them.",
    {
        "tasks": LazyCommand("mapt.cli.tasks", "tasks", "List the tasks."),
        "train": LazyCommand("mapt.cli.train", "train", "Train a policy per seed, evaluate it and record a video."),
        "imitate": LazyCommand(
            "mapt.cli.imitate",
            "imitate",
            "Train a policy per seed on stored behaviour, evaluate it and record a video.",
        ),
        "evaluate": LazyCommand(
            "mapt.cli.results", "evaluate", "Evaluate a trained policy by the true reward, and by a scripted teacher."
        ),
        "curves": LazyCommand("mapt.cli.results", "curves", "Plot and tabulate the true return of runs."),
        "dataset": LazyCommand("mapt.cli.benchmarks", "dataset", "Record a dataset of segments per seed."),
        "table": LazyCommand("mapt.cli.benchmarks", "table", "Compare reward models on recorded datasets."),
        "benchmark": LazyCommand("mapt.cli.paper", "benchmark", "Repeat published experiments."),
        "report": LazyCommand("mapt.cli.benchmarks", "report", "Describe trained reward models in an HTML report."),
        "push": LazyCommand(
            "mapt.cli.hub", "push", "Upload a reward model, a run or a policy to the Hugging Face Hub."
        ),
        "pull": LazyCommand(
            "mapt.cli.hub", "pull", "Download a reward model, a run or a policy from the Hugging Face Hub."
        ),
    },
)


def main() -> None:
    """Entry point of the script `mapt`."""
    run_app(app, "mapt", (MaptError,))
