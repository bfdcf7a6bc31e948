"""A replay to record, by whichever process."""

from dataclasses import dataclass
from pathlib import Path

from mapt.processes import Desk
from mapt.studies.errors import RecordingStopped
from mapt.studies.recording import Recording, record_replay


@dataclass(frozen=True, slots=True)
class ReplayJob:
    """A replay to record."""

    recording: Recording
    #: where it will lie
    folder: Path
    #: as `n_threads` of `make_task`
    physics_threads: int = 0


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a recording is."""

    #: of the policy's training
    steps: int
    #: mean true reward of a step in the newest rollout
    reward: float


def make_replay(job: ReplayJob, desk: Desk) -> None:
    """`record_replay` by a worker of `run_jobs`, which is told a `Progress` after each rollout.

    Raises:
        RecordingStopped: if the parent asked to stop, or is gone.
        See `record_replay` for what else.
    """

    def tell(steps: int, reward: float) -> None:
        desk.tell(Progress(steps, reward))
        if desk.unwanted():
            raise RecordingStopped(job.folder)

    record_replay(job.recording, job.folder, tell, physics_threads=job.physics_threads)
