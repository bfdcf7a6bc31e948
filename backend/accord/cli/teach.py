"""accord teach: a scripted teacher for an experiment of a service that runs."""

from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from accord.cli.client import Api
from accord.cli.options import Home, Parameters, TeacherName, Token, Url, load_settings, service_url
from accord.cli.output import out, say
from accord.cli.teaching import parse_teacher, teach_experiment
from accord.workers.runner import Stop


def teach(
    *,
    experiment: Annotated[str, typer.Option(help="Id of the experiment to label, exp_...")],
    token: Token,
    url: Url = None,
    teacher: TeacherName = "oracle",
    parameter: Parameters = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the teacher's chance.")] = 0,
    labels: Annotated[
        int | None,
        typer.Option(min=1, help="How many labels to give.  [default: what the experiment's budget still lacks]"),
    ] = None,
    home: Home = None,
) -> None:
    """Label an experiment by a program that knows the true reward. It uses the same API as everyone."""
    choice = parse_teacher(teacher, parameter or ())
    stop = Stop()
    stop.install()
    api = Api(url or service_url(load_settings(home)), token, stopped=lambda: stop.requested)
    counts = api.get(f"/experiments/{experiment}")["labels"]
    wanted = labels or max(0, counts["budget"] - counts["labels"])
    columns = (TextColumn("labels"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=out) as progress:
        bar = progress.add_task("labels", total=wanted)
        taught = teach_experiment(
            api,
            experiment,
            choice.teacher(seed),
            wanted,
            on_progress=lambda given: progress.update(bar, completed=given),
            stopped=lambda: stop.requested,
        )
    api.close()
    say(f"{taught.labels} labels given ({taught.reason}).")
