"""What a table is made of: the cells, in the order in which they are made."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mapt.rewards.config import PresetName
from mapt.rewards.train_config import TrainConfig
from mapt.studies.cell import CellSettings
from mapt.studies.cell_job import CellJob
from mapt.studies.errors import InvalidStudy
from mapt.studies.judging import Judge
from mapt.studies.pairs import split_replay
from mapt.studies.replay import Replay
from mapt.studies.variants import network_of, training_of

#: what is not fit for a folder's name everywhere
_NO_PATH = re.compile(r"[^\w.+=-]")


@dataclass(frozen=True, slots=True)
class TablePlan:
    """A table: every model with every teacher, number of labels and seed."""

    task: str
    models: tuple[str, ...]
    teachers: tuple[str, ...]
    labels: tuple[int, ...]
    seeds: tuple[int, ...]
    preset: PresetName
    #: fresh pairs each cell is tested on
    test_pairs: int
    #: as in `TrainConfig`
    device: str
    #: the model that the others are tested against
    baseline: str

    def __post_init__(self) -> None:
        for name in ("models", "teachers", "labels", "seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) != len(values):
                raise InvalidStudy(f"{name} must be at least one, each once; got {', '.join(map(str, values))!r}")
        if min(self.labels) < 2 or min(self.seeds) < 0 or self.test_pairs < 1:
            raise InvalidStudy("labels must be 2 or more, seeds 0 or more, test pairs 1 or more")
        if self.baseline not in self.models:
            raise InvalidStudy(f"the baseline {self.baseline!r} is none of the models: {', '.join(self.models)}")


def replay_folder(root: Path, seed: int) -> Path:
    """Where the replay of a seed lies among those of a study."""
    return root / f"seed-{seed}"


def model_folder(root: Path, settings: CellSettings) -> Path:
    """Where the model of a cell is kept: a name to read, and one that only these settings have."""
    words = f"{settings.model}-{settings.teacher}-{settings.labels}-seed-{settings.seed}"
    return root / f"{_NO_PATH.sub('_', words)}-{settings.key[:8]}"


def table_jobs(plan: TablePlan, replays: Mapping[int, Replay], models: Path | None = None) -> list[CellJob]:
    """Every cell of `plan`: few labels first, so that a table that is not finished can be read.

    Args:
        replays: one of the task for each seed.
        models: folder to keep the trained models in; None lets them go.

    Raises:
        InvalidStudy, InvalidConfig, UnknownTeacher, InvalidTeacher: if a model, teacher or setting is unknown, or a
            replay does not fit.
    """
    for replay in replays.values():
        if replay.origin.get("task") != plan.task:
            raise InvalidStudy(f"the replay in {replay.path} is of {replay.origin.get('task')}, not of {plan.task}")
        split_replay(len(replay), 0)
    fingerprints = {seed: replay.fingerprint() for seed, replay in replays.items()}
    cells = [
        CellSettings(
            task=plan.task,
            replay=fingerprints[seed],
            model=model,
            network=network_of(model, plan.preset, replays[seed].source.layout).to_dict(),
            training=_from_scratch(training_of(model, plan.preset, seed, plan.device)),
            teacher=teacher,
            teacher_parameters=Judge(teacher, replays[seed], seed).parameters(),
            labels=labels,
            seed=seed,
            test_pairs=plan.test_pairs,
        )
        for labels in sorted(plan.labels)
        for seed in plan.seeds
        for teacher in plan.teachers
        for model in plan.models
    ]
    return [
        CellJob(cell, replays[cell.seed].path, None if models is None else model_folder(models, cell)) for cell in cells
    ]


def _from_scratch(training: TrainConfig) -> dict[str, object]:
    # No cell goes on from another: what a warm start does decides nothing of it.
    return {name: value for name, value in training.to_dict().items() if not name.startswith("warm_")}
