"""mapt dataset: record replays to draw preferences from."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from mapt.cli.bars import Bars
from mapt.cli.options import PolicySteps, Seeds, Segments, SegmentSteps, Task, Workers
from mapt.cli.output import complain, note
from mapt.processes import at_once, cores_of_each, run_jobs
from mapt.studies.naming import numbers
from mapt.studies.plan import replay_folder
from mapt.studies.recording import Recording
from mapt.studies.replay import Replay
from mapt.studies.replay_job import Progress, ReplayJob, make_replay

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
    n_workers = at_once(workers, len(recordings))
    threads = cores_of_each(n_workers)
    jobs = [ReplayJob(recording, replay_folder(root, recording.seed), threads) for recording in recordings]
    failed = False
    with Bars(_NOTED_SHARE) as bars:

        def begin(job: ReplayJob) -> None:
            bars.begin(job, _name(job), job.recording.policy_steps)

        def tell(job: ReplayJob, news: Progress) -> None:
            bars.show(job, news.steps, f"true reward of a step {news.reward:.2f}")

        for done in run_jobs(make_replay, jobs, n_workers, started=begin, told=tell):
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
