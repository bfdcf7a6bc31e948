"""accord demo: the whole loop without a person. A real service, a scripted teacher over REST, a table and a plot."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from accord.cli.client import Api
from accord.cli.demo_runs import (
    PREFERENCES,
    Grid,
    Lesson,
    RunPlan,
    RunResult,
    RunState,
    check_known,
    experiments_by_name,
    pause_others,
    run_experiment,
)
from accord.cli.options import Parameters, TeacherName, parse_numbers, parse_settings, parse_words
from accord.cli.output import note, on_terminal, out, say
from accord.cli.own_service import OwnService
from accord.cli.results import rows_of, table, write
from accord.cli.teach import TeacherChoice, parse_teacher
from accord.domain.enums import Role
from accord.workers.runner import Stop
from mapt.processes import parallel_jobs

#: without a terminal, a line each time so much more of a run is done
_NOTED_SHARE = 0.1


def demo(
    *,
    task: Annotated[str, typer.Option(help="Task by name; GET /api/v1/tasks lists them.")] = "HalfCheetah-6x1",
    teacher: TeacherName = "oracle",
    parameter: Parameters = None,
    labels: Annotated[str, typer.Option(help="Numbers of labels, with commas between; each is a run.")] = "500",
    reward_model: Annotated[
        str, typer.Option(help="Models that learn from the labels, with commas between; each is a run.")
    ] = "MAPT",
    steps: Annotated[int, typer.Option(min=1, help="Environment steps of each policy.")] = 1_000_000,
    seed: Annotated[str, typer.Option(help="Seeds, with commas between; each is a run.")] = "0",
    policy: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="A setting of the policy, such as algorithm=mat; as often as wanted."
        ),
    ] = None,
    baseline: Annotated[
        bool, typer.Option(help="Train the same learner on the true reward beside it, for each seed.")
    ] = True,
    clips: Annotated[bool, typer.Option(help="Make a clip of every segment that is asked about.")] = False,
    initial_labels: Annotated[
        int | None,
        typer.Option(min=2, help="Labels before the first reward version.  [default: a fifth of them, 100 at most]"),
    ] = None,
    labels_per_version: Annotated[
        int | None, typer.Option(min=1, help="New labels for each further version.  [default: a tenth of them]")
    ] = None,
    at_once: Annotated[
        int, typer.Option(min=0, help="Runs at once, each with workers of its own; 0 for one per core.")
    ] = 0,
    home: Annotated[
        Path | None, typer.Option(help="New folder for the service's data.  [default: home, in the output folder]")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="Folder of results.json, curves.csv, returns.png.  [default: demo-<time>]")
    ] = None,
) -> None:
    """Run the whole loop with a scripted teacher and compare the result with the true reward's.

    A demo that was ended goes on where it was when the same command is given again.
    """
    choice = parse_teacher(teacher, parameter or ())
    plans = Grid(
        task=task,
        total_steps=steps,
        seeds=parse_numbers("--seed", seed, 0),
        labels=parse_numbers("--labels", labels, 2),
        reward_models=parse_words("--reward-model", reward_model),
        initial_labels=initial_labels,
        labels_per_version=labels_per_version,
        render_clips=clips,
        baseline=baseline,
        policy=parse_settings("--set", policy or (), "algorithm=mat"),
    ).plans(choice.title)
    folder = output or Path(datetime.now().astimezone().strftime("demo-%Y%m%d-%H%M%S"))
    stop = Stop()
    stop.install()
    n_runs = parallel_jobs(at_once, len(plans))
    with OwnService(home or folder / "home", _environment(clips, n_runs), lambda: stop.requested) as service:
        lesson = _lesson(service, choice, stop)
        try:
            results, paths = _run_all(lesson, plans, n_runs, stop, folder)
        finally:
            lesson.close()
    out.print(table(rows_of(results), f"{task}: true return after {steps:,} steps"))
    say("[dim]" + ", ".join(str(path) for path in paths) + "[/dim]")


def _environment(clips: bool, at_once: int) -> dict[str, str]:
    workers = {"ACCORD_POLICY_WORKERS": str(at_once), "ACCORD_REWARD_WORKERS": str(at_once)}
    return workers if clips else workers | {"ACCORD_RENDER_WORKERS": "0"}


def _lesson(service: OwnService, teacher: TeacherChoice, stop: Stop) -> Lesson:
    def stopped() -> bool:
        return stop.requested

    url = service.url()
    note("demo", f"service at {url}, data in {service.home}")
    researcher, labeller = (
        Api(url, service.token(name, role), stopped=stopped)
        for name, role in (("demo researcher", Role.RESEARCHER), (f"demo {teacher.name}", Role.TEACHER))
    )
    return Lesson(researcher, labeller, teacher, stopped, service.check)


def _run_all(
    lesson: Lesson, plans: Sequence[RunPlan], at_once: int, stop: Stop, folder: Path
) -> tuple[list[RunResult], list[Path]]:
    """Results in the plans' order, and the files that hold them: written anew after every run."""
    known = experiments_by_name(lesson.researcher)
    check_known(plans, known)
    pause_others(lesson.researcher, plans, known)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn())
    results: dict[str, RunResult] = {}
    paths: list[Path] = []
    with (
        Progress(*columns, console=out, disable=not on_terminal()) as progress,
        ThreadPoolExecutor(at_once) as pool,
    ):
        # Finished ones first, so that the files are never without them.
        order = sorted(plans, key=lambda plan: known.get(plan.name, {}).get("status") != "finished")
        runs = [pool.submit(run_experiment, lesson, plan, known, _shower(progress, plan)) for plan in order]
        try:
            for run in as_completed(runs):
                results[run.result().plan.name] = run.result()
                paths = write(folder, _ordered(results, plans))
        finally:
            # Whoever still runs after a failure should not.
            stop.request()
            pool.shutdown(cancel_futures=True)
    return _ordered(results, plans), paths


def _ordered(results: dict[str, RunResult], plans: Sequence[RunPlan]) -> list[RunResult]:
    return [results[plan.name] for plan in plans if plan.name in results]


def _shower(progress: Progress, plan: RunPlan) -> Callable[[RunState], None]:
    bar: TaskID = progress.add_task(plan.name, total=plan.total_steps, state="waiting", start=False)
    noted = -_NOTED_SHARE

    def show(state: RunState) -> None:
        nonlocal noted
        words = describe(plan, state)
        progress.start_task(bar)
        progress.update(bar, completed=min(state.steps, plan.total_steps), state=words)
        share = state.steps / plan.total_steps
        if not on_terminal() and share >= noted + _NOTED_SHARE:
            noted = share
            note(plan.name, f"{share:.0%} of steps, {words}")

    return show


def describe(plan: RunPlan, state: RunState) -> str:
    """The words beside the bar."""
    parts = [] if state.true_return is None else [f"return {state.true_return:,.0f}"]
    if plan.reward_source == PREFERENCES:
        parts = [f"labels {state.labels}/{plan.label_budget}", f"version {state.version}", *parts]
    return " · ".join([*parts, state.detail])
