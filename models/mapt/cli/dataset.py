"""mapt dataset: record replays to draw preferences from."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mapt.cli.options import PolicySteps, Seeds, Segments, SegmentSteps, Task
from mapt.cli.output import note, on_terminal, out
from mapt.studies.naming import numbers
from mapt.studies.plan import replay_folder
from mapt.studies.recording import Recording, record_replay
from mapt.studies.replay import Replay

#: without a terminal, a line each time so much more is done
_NOTED_SHARE = 0.25


def dataset(
    *,
    output: Annotated[Path, typer.Option(help="Folder of the replays: one folder in it for each seed.")],
    task: Task = "HalfCheetah-6x1",
    seeds: Seeds = "0",
    policy_steps: PolicySteps = 800_000,
    segment_steps: SegmentSteps = 50,
    segments: Segments = 6000,
) -> None:
    """Train a team on the true reward and keep segments of its whole training."""
    recordings = [Recording(task, policy_steps, segment_steps, segments, seed) for seed in numbers("--seeds", seeds, 0)]
    record_all(recordings, output)


def record_all(recordings: Sequence[Recording], root: Path) -> list[Replay]:
    """Record one replay after the other, with a bar for each."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"))
    with Progress(
        *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=out, disable=not on_terminal()
    ) as progress:
        return [_record(recording, replay_folder(root, recording.seed), progress) for recording in recordings]


def _record(recording: Recording, folder: Path, progress: Progress) -> Replay:
    bar = progress.add_task(f"replay, seed {recording.seed}", total=recording.policy_steps, state="")
    noted = 0.0

    def show(steps: int, reward: float) -> None:
        nonlocal noted
        words, share = f"true reward of a step {reward:.2f}", min(1.0, steps / recording.policy_steps)
        progress.update(bar, completed=steps, state=words)
        if not on_terminal() and share >= noted + _NOTED_SHARE:
            noted = share
            note(f"replay, seed {recording.seed}: {share:.0%}, {words}")

    replay = record_replay(recording, folder, show)
    note(f"{len(replay):,} segments of {replay.source.n_steps} steps in {folder}")
    return replay
