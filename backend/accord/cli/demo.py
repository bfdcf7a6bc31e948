"""accord demo: the whole loop without a person. A real service, a scripted teacher over REST, a table and a plot."""

from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from accord.cli.client import Api
from accord.cli.options import Parameters, TeacherName
from accord.cli.output import note, on_terminal, out, say
from accord.cli.results import rows_of, table, write
from accord.cli.runs import Lesson, RunPlan, RunResult, RunState, run_experiment
from accord.cli.service import OwnService
from accord.cli.teaching import TeacherChoice, parse_teacher
from accord.domain.errors import Invalid
from accord.domain.words import Role
from accord.workers.stop import Stop

#: without a terminal, a line each time so much more of a run is done
_NOTED_SHARE = 0.1


def demo(
    *,
    task: Annotated[str, typer.Option(help="Task by name; GET /api/v1/tasks lists them.")] = "HalfCheetah-6x1",
    teacher: TeacherName = "oracle",
    parameter: Parameters = None,
    labels: Annotated[int, typer.Option(min=2, help="Labels it gives for each seed.")] = 500,
    steps: Annotated[int, typer.Option(min=1, help="Environment steps of each policy.")] = 1_000_000,
    seed: Annotated[str, typer.Option(help="Seeds, with commas between.")] = "0",
    baseline: Annotated[
        bool, typer.Option(help="Train the same learner on the true reward beside it, for each seed.")
    ] = True,
    clips: Annotated[bool, typer.Option(help="Make a clip of every segment that is asked about.")] = False,
    initial_labels: Annotated[
        int | None, typer.Option(min=2, help="Labels before the first reward version.  [default: a fifth of them]")
    ] = None,
    labels_per_version: Annotated[
        int | None, typer.Option(min=1, help="New labels for each further version.  [default: a tenth of them]")
    ] = None,
    home: Annotated[
        Path | None, typer.Option(help="New folder for the service's data.  [default: home, in the output folder]")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="Folder of results.json, curves.csv, returns.png.  [default: demo-<time>]")
    ] = None,
) -> None:
    """Run the whole loop with a scripted teacher and compare the result with the true reward's."""
    seeds, choice = parse_seeds(seed), parse_teacher(teacher, parameter or ())
    folder = output or Path(datetime.now().astimezone().strftime("demo-%Y%m%d-%H%M%S"))
    stop = Stop()
    stop.install()
    plans = [
        RunPlan(
            name=f"{task} seed {number}" + (", true reward" if source == "true" else f", {labels} labels"),
            task=task,
            reward_source=source,
            seed=number,
            total_steps=steps,
            label_budget=labels,
            initial_labels=initial_labels or max(2, labels // 5),
            labels_per_version=labels_per_version or max(1, labels // 10),
            render_clips=clips,
        )
        for number in seeds
        for source in (("true", "preferences") if baseline else ("preferences",))
    ]
    environment = {} if clips else {"ACCORD_RENDER_WORKERS": "0"}
    with OwnService(home or folder / "home", environment, lambda: stop.requested) as service:
        results = _run_all(service, plans, choice, stop)
    paths = write(folder, results)
    out.print(table(rows_of(results), f"{task}: true return after {steps:,} steps"))
    say("[dim]" + ", ".join(str(path) for path in paths) + "[/dim]")


def parse_seeds(text: str) -> list[int]:
    """Raises Invalid, with an example."""
    try:
        seeds = [int(part) for part in text.split(",")]
    except ValueError as error:
        raise Invalid(f"--seed {text!r} is no list of numbers. It looks like 0,1,2.") from error
    if len(set(seeds)) != len(seeds) or min(seeds) < 0:
        raise Invalid(f"--seed {text!r}: seeds are 0 or more, each once.")
    return seeds


def _run_all(service: OwnService, plans: Sequence[RunPlan], teacher: TeacherChoice, stop: Stop) -> list[RunResult]:
    def stopped() -> bool:
        return stop.requested

    url = service.url()
    note("demo", f"service at {url}, data in {service.home}")
    apis = [
        Api(url, service.token(name, role), stopped=stopped)
        for name, role in (("demo researcher", Role.RESEARCHER), (f"demo {teacher.name}", Role.TEACHER))
    ]
    lesson = Lesson(apis[0], apis[1], teacher, stopped, service.check)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn())
    with Progress(*columns, console=out, disable=not on_terminal()) as progress:
        results = [run_experiment(lesson, plan, _shower(progress, plan)) for plan in plans]
    for api in apis:
        api.close()
    return results


def _shower(progress: Progress, plan: RunPlan) -> Callable[[RunState], None]:
    bar: TaskID = progress.add_task(plan.name, total=plan.total_steps, state="")
    noted = -_NOTED_SHARE

    def show(state: RunState) -> None:
        nonlocal noted
        words = describe(plan, state)
        progress.update(bar, completed=min(state.steps, plan.total_steps), state=words)
        share = state.steps / plan.total_steps
        if not on_terminal() and share >= noted + _NOTED_SHARE:
            noted = share
            note(plan.name, f"{share:.0%} of steps, {words}")

    return show


def describe(plan: RunPlan, state: RunState) -> str:
    """The words beside the bar."""
    parts = [] if state.true_return is None else [f"return {state.true_return:,.0f}"]
    if plan.reward_source == "preferences":
        parts = [f"labels {state.labels}/{plan.label_budget}", f"version {state.version}", *parts]
    return " · ".join([*parts, state.detail])
