"""mapt dataset: record replays to draw preferences from."""

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mapt.benchmarks.figures import draw_table
from mapt.benchmarks.job import CellFolder, CellJob, TablePlan, code_fingerprint, make_cell, replay_folder, table_jobs
from mapt.benchmarks.recorded_dataset import Recording, RecordingProgress, Replay, ReplayJob, make_replay
from mapt.benchmarks.report import ReportPlan, make_report
from mapt.benchmarks.specification import numbers, words
from mapt.benchmarks.tables import Summary, markdown, summarise, write_cells, write_comparisons
from mapt.cli.options import PolicySteps, Preset, Seeds, Segments, SegmentSteps, Task, Workers
from mapt.cli.output import Bars, complain, note, on_terminal, out, say
from mapt.errors import InvalidConfig
from mapt.processes import cores_per_job, parallel_jobs, run_jobs
from mapt.rewards.checkpoints import CARD_FILE, WEIGHTS_FILE, load_reward_model
from mapt.rewards.config import MODEL_NAMES
from mapt.rewards.model import RewardModel

_NOTED_SHARE = 0.25


def dataset(
    *,
    output: Annotated[Path, typer.Option(help="Folder of the replays: one folder in it for each seed.")],
    task: Task = "HalfCheetah-6x1",
    seeds: Seeds = "0",
    policy_steps: PolicySteps = 800_000,
    segment_steps: SegmentSteps = 50,
    segments: Segments = 6000,
    workers: Workers = 0,
) -> None:
    """Train a team on the true reward and keep segments of its whole training."""
    recordings = [Recording(task, policy_steps, segment_steps, segments, seed) for seed in numbers("--seeds", seeds, 0)]
    record_all(recordings, output, workers)


def record_all(recordings: Sequence[Recording], root: Path, workers: int) -> None:
    """Record replays, `workers` of them at once, with a bar for each.

    Raises:
        typer.Exit: if one could not be recorded; the others are.
    """
    n_workers = parallel_jobs(workers, len(recordings))
    threads = cores_per_job(n_workers)
    jobs = [ReplayJob(recording, replay_folder(root, recording.seed), threads) for recording in recordings]
    failed = False
    with Bars(_NOTED_SHARE) as bars:

        def begin(job: ReplayJob) -> None:
            bars.begin(job, _name(job), job.recording.policy_steps)

        def tell(job: ReplayJob, news: RecordingProgress) -> None:
            bars.show(job, news.steps, f"true reward of a step {news.reward:.2f}")

        for done in run_jobs(make_replay, jobs, n_workers, on_start=begin, on_message=tell):
            bars.end(done.job)
            if done.failure is not None:
                failed = True
                complain(f"{_name(done.job)}: {done.failure}")
                continue
            replay = Replay.open(done.job.folder)
            note(f"{_name(done.job)}: {len(replay):,} segments of {replay.source.n_steps} steps in {replay.path}")
    if failed:
        raise typer.Exit(2)


def _name(job: ReplayJob) -> str:
    return f"replay, seed {job.recording.seed}"


def table(
    *,
    output: Annotated[
        Path, typer.Option(help="Folder of table.md, cells.csv, comparisons.csv, table.png and the finished cells.")
    ],
    task: Task = "HalfCheetah-6x1",
    models: Annotated[
        str,
        typer.Option(help="Models, with commas between; NAME:setting=value differs from NAME in a setting."),
    ] = ",".join(MODEL_NAMES),
    teachers: Annotated[str, typer.Option(help="Scripted teachers, with commas between.")] = "oracle",
    labels: Annotated[str, typer.Option(help="Numbers of labels, with commas between.")] = "500,2000,10000",
    seeds: Seeds = "0,1,2",
    baseline: Annotated[
        str | None,
        typer.Option(help="Model that the others are tested against.  [default: MA-MLP, or the first model]"),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(help="Folder of replays, as `mapt dataset` leaves it.  [default: replays, in the output folder]"),
    ] = None,
    preset: Annotated[Preset, typer.Option(help="Size of the networks and their training.")] = Preset.SMALL,
    segment_steps: SegmentSteps = 50,
    policy_steps: PolicySteps = 800_000,
    segments: Segments = 6000,
    test_pairs: Annotated[int, typer.Option(min=1, help="Fresh pairs that each cell is tested on.")] = 4000,
    device: Annotated[str, typer.Option(help="Where models are trained: cpu, cuda or auto.")] = "cpu",
    workers: Workers = 0,
    keep_models: Annotated[
        bool, typer.Option("--keep-models", help="Keep every trained model in models, in the output folder.")
    ] = False,
    same_code: Annotated[
        bool, typer.Option("--same-code", help="Make cells anew that another state of the code made.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Make no cell: write the table of those that are finished.")
    ] = False,
) -> None:
    """Train every model on every number of labels of every teacher, and compare them on fresh pairs.

    A run that was ended goes on where it was when the same command is given again.
    """
    names = words("--models", models)
    plan = TablePlan(
        task=task,
        models=names,
        teachers=words("--teachers", teachers),
        labels=numbers("--labels", labels, 2),
        seeds=numbers("--seeds", seeds, 0),
        preset=preset.value,
        test_pairs=test_pairs,
        device=device,
        baseline=baseline or ("MA-MLP" if "MA-MLP" in names else names[0]),
    )
    root = replay or output / "replays"
    recordings = [Recording(task, policy_steps, segment_steps, segments, seed) for seed in plan.seeds]
    jobs = table_jobs(plan, _replays(recordings, root, workers), output / "models" if keep_models else None)
    folder = CellFolder(output / "cells")
    if not dry_run:
        _make(jobs, folder, workers, same_code)
    summary = summarise(plan, [cell for job in jobs if (cell := folder.read(job.settings)) is not None])
    for path in write(summary, output):
        say(f"[dim]{path}[/dim]")
    if summary.missing and not dry_run:
        complain(f"{summary.missing} cells are missing; the same command makes them.")
        raise typer.Exit(1)


def write(summary: Summary, output: Path) -> list[Path]:
    """Write the table in all its forms. Returns their paths."""
    output.mkdir(parents=True, exist_ok=True)
    paths = [output / name for name in ("table.md", "cells.csv", "comparisons.csv", "table.png")]
    paths[0].write_text(markdown(summary))
    write_cells(summary, paths[1])
    write_comparisons(summary, paths[2])
    draw_table(summary, paths[3])
    return paths


def _replays(recordings: Sequence[Recording], root: Path, workers: int) -> dict[int, Replay]:
    """The replays that are there, and the others recorded now."""
    absent = [recording for recording in recordings if not replay_folder(root, recording.seed).exists()]
    record_all(absent, root, workers)
    return {recording.seed: Replay.open(replay_folder(root, recording.seed)) for recording in recordings}


def _make(jobs: Sequence[CellJob], folder: CellFolder, workers: int, same_code: bool) -> None:
    wanted = [job for job in jobs if not _finished(job, folder, same_code)]
    n_workers = parallel_jobs(workers, len(wanted))
    note(f"{len(jobs)} cells, {len(jobs) - len(wanted)} of them finished; {n_workers} at once")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(
        *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=out, disable=not on_terminal()
    ) as progress:
        bar = progress.add_task("cells", total=len(jobs), completed=len(jobs) - len(wanted))
        started: dict[str, float] = {}
        make = partial(make_cell, folder.path)
        for done in run_jobs(
            make, wanted, n_workers, on_start=lambda job: started.update({job.settings.key: time.time()})
        ):
            settings = done.job.settings
            name = f"{settings.model}, {settings.teacher}, {settings.labels:,} labels, seed {settings.seed}"
            if done.failure:
                complain(f"{name}: {done.failure}")
                continue
            progress.advance(bar)
            cell = folder.read(settings)
            if cell is not None:
                seconds = time.time() - started[settings.key]
                note(f"{name}: accuracy {cell.result.metrics.get('accuracy', float('nan')):.4f}, {seconds:.0f} s")


def _finished(job: CellJob, folder: CellFolder, same_code: bool) -> bool:
    cell = folder.read(job.settings)
    if cell is None or (same_code and cell.code != code_fingerprint()):
        return False
    return job.model is None or (job.model / CARD_FILE).exists()


def report(
    checkpoints: Annotated[
        list[str],
        typer.Argument(help=f"Folders of {WEIGHTS_FILE} and {CARD_FILE}; NAME=FOLDER gives a model a name."),
    ],
    *,
    replay: Annotated[Path, typer.Option(help="Folder of one replay, such as seed-0 of `mapt dataset`.")],
    output: Annotated[Path, typer.Option(help="Folder of report.html, report.json and the pictures.")],
    teacher: Annotated[str, typer.Option(help="Scripted teacher who labels pairs for the calibration.")] = "oracle",
    pairs: Annotated[int, typer.Option(min=1, help="Pairs that it labels.")] = 4000,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, help="Take only segments that no cell of `mapt table` with this seed learns from.  [default: all]"
        ),
    ] = None,
) -> None:
    """Show learned beside true rewards, what the attentions look at, and how sure the model may be."""
    models = load_models(checkpoints)
    for path in make_report(models, Replay.open(replay), ReportPlan(teacher, pairs, seed), output):
        say(f"[dim]{path}[/dim]")


def load_models(checkpoints: list[str]) -> dict[str, RewardModel]:
    """Models by name.

    Raises:
        InvalidConfig: if two have the same name.
        CheckpointError: if one cannot be read.
    """
    models: dict[str, RewardModel] = {}
    for text in checkpoints:
        # A folder's own name may hold an equals sign.
        name, equals, folder = ("", "", text) if Path(text).is_dir() else text.partition("=")
        path = Path(folder if equals or not name else text)
        name = name if equals else path.name
        if name in models:
            raise InvalidConfig(f"two models are called {name!r}; give them names: NAME=FOLDER")
        models[name] = load_reward_model(path / WEIGHTS_FILE, path / CARD_FILE).model
    return models
