"""A cell to make, by whichever process."""

from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from mapt.processes import Desk
from mapt.rewards.checkpoints import save_reward_model
from mapt.rewards.trainer import TrainedReward
from mapt.studies.cell import CellSettings, run_cell
from mapt.studies.cell_folder import CellFolder, code_fingerprint
from mapt.studies.replay import Replay


@dataclass(frozen=True, slots=True)
class CellJob:
    """A cell to make."""

    settings: CellSettings
    #: folder of the replay it is made from
    replay: Path
    #: where the trained model is kept; None lets it go
    model: Path | None = None


def make_cell(cells: Path, job: CellJob, desk: Desk) -> None:
    """Make a cell into the folder `cells`, unless it is no longer wanted; `run_jobs` has a worker do it."""
    replay, code = Replay.open(job.replay), _code()
    result = run_cell(job.settings, replay, desk.unwanted, partial(_keep, job.model, replay.source.n_steps))
    if result is not None:
        CellFolder(cells).write(job.settings, result, code)


@cache
def _code() -> str:
    """Of the files as the worker that calls this first has loaded them."""
    return code_fingerprint()


def _keep(folder: Path | None, segment_steps: int, trained: TrainedReward) -> None:
    if folder is not None:
        save_reward_model(trained.model, trained.metrics, segment_steps=segment_steps).write(folder)
