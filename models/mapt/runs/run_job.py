"""A run to be made, by whichever process."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mapt.runs.complete import complete_run
from mapt.runs.evaluation import Evaluation
from mapt.runs.folder import RunFolder
from mapt.runs.metrics_file import Metrics
from mapt.runs.pool import Desk
from mapt.runs.settings import RunSettings
from mapt.runs.stopping import stop_requests
from mapt.runs.training import Watch

#: what is told of a run on its way: what was written down of an iteration, or a sentence
News = Metrics | str


@dataclass(frozen=True, slots=True)
class RunJob:
    """A run to be made."""

    settings: RunSettings
    folder: Path
    #: between two checkpoints at least
    checkpoint_seconds: float
    #: film the final policy
    video: bool
    #: as `n_threads` of `make_task`
    physics_threads: int


def make_run(job: RunJob, told: Callable[[News], None], stopped: Callable[[], bool]) -> Evaluation | None:
    """What `complete_run` gives and raises."""
    return complete_run(
        job.settings,
        RunFolder(job.folder),
        job.checkpoint_seconds,
        Watch(on_iteration=told, note=told, stopped=stopped),
        video=job.video,
        physics_threads=job.physics_threads,
    )


def make_run_apart(job: RunJob, desk: Desk) -> Evaluation | None:
    """`make_run` by a worker of `run_jobs`, which Ctrl-C and SIGTERM reach as well as its parent."""
    with stop_requests() as asked:
        return make_run(job, desk.tell, lambda: asked() or desk.unwanted())
