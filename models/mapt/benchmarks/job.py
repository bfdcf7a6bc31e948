"""One cell of a table: a model trained on so many labels of one teacher, with one seed, and what came of it."""

import hashlib
import json
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path

from safetensors import SafetensorError
from safetensors.numpy import load_file, save

import mapt.preferences
import mapt.rewards
from mapt.benchmarks.evaluate import Examination, Judge, examine, labelled_dataset, split_replay
from mapt.benchmarks.recorded_dataset import Replay
from mapt.benchmarks.specification import Written
from mapt.errors import DamagedCell, InvalidConfig
from mapt.io import atomic_write
from mapt.preferences.storage import SegmentLayout
from mapt.processes import ParentConnection
from mapt.rewards.checkpoints import save_reward_model
from mapt.rewards.config import PresetName, RewardConfig, TrainConfig
from mapt.rewards.model import RewardModel
from mapt.rewards.trainer import TrainedReward, train_reward_model


@dataclass(frozen=True, slots=True)
class CellSettings:
    """Everything that decides a cell, but for the code."""

    task: str
    #: fingerprint of the replay that pairs are drawn from
    replay: str
    #: the model as the table calls it
    model: str
    network: Mapping[str, object]
    training: Mapping[str, object]
    teacher: str
    teacher_parameters: Mapping[str, object]
    labels: int
    #: of the replay's split, the pairs, the teacher's chance, the network's start and the training
    seed: int
    #: fresh pairs it is tested on
    test_pairs: int

    @property
    def key(self) -> str:
        """A name that only these settings have."""
        text = json.dumps(asdict(self), sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:24]

    def to_dict(self) -> dict[str, object]:
        """Plain values, fit for JSON."""
        return asdict(self)


def run_cell(
    settings: CellSettings,
    replay: Replay,
    stop: Callable[[], bool] | None = None,
    keep: Callable[[TrainedReward], None] | None = None,
) -> Examination | None:
    """Have pairs labelled, train, examine. None if `stop` came true; else `keep` is given what was trained.

    Beside those of `Examination`, the metrics have of the training: `train_holdout_accuracy`, `train_holdout_loss`,
    `train_epochs`, `parameters`, `seconds` and `cpu_seconds`.
    """
    dataset = labelled_dataset(Judge(settings.teacher, replay, settings.seed), replay, settings.labels, settings.seed)
    started, started_cpu = time.perf_counter(), time.process_time()
    network, training = RewardConfig.from_dict(settings.network), TrainConfig.from_dict(settings.training)
    trained = train_reward_model(dataset, network, training, stop=stop)
    seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - started_cpu
    if trained.metrics["stopped"]:
        return None
    if keep is not None:
        keep(trained)
    examined = examine(trained.model, replay, settings.teacher, settings.test_pairs, settings.seed)
    kept = ("holdout_accuracy", "holdout_loss", "epochs")
    of_training = {f"train_{name}": trained.metrics[name] for name in kept if name in trained.metrics}
    cost = {"parameters": float(count_parameters(trained.model)), "seconds": seconds, "cpu_seconds": cpu_seconds}
    return replace(examined, metrics={**examined.metrics, **of_training, **cost})


def count_parameters(model: RewardModel) -> int:
    """Numbers that training can move."""
    return sum(parameter.numel() for parameter in model.parameters() if parameter.requires_grad)


FORMAT_VERSION = 1
_ARRAYS = ("logits", "labels", "clean_labels", "pairs")
_KEY_LENGTH_SHOWN = 12


@dataclass(frozen=True, slots=True)
class Cell:
    """A finished cell."""

    settings: CellSettings
    result: Examination
    #: which state of the library's code made it, see `code_fingerprint`
    code: str


class CellFolder:
    """One JSON file and one of arrays for each cell, named by the key of its settings."""

    def __init__(self, folder: Path) -> None:
        self.path = folder

    def read(self, settings: CellSettings) -> Cell | None:
        """The cell of exactly these settings, or None if it was not made yet.

        Raises:
            DamagedCell: if its files are not as they were written.
        """
        card_path, arrays_path = self._paths(settings)
        if not card_path.exists():
            return None
        try:
            card = json.loads(card_path.read_text())
            arrays = load_file(arrays_path)
            if card["format_version"] != FORMAT_VERSION:
                raise DamagedCell(card_path, f"its format is {card['format_version']}, known is {FORMAT_VERSION}")
            if card["settings"] != json.loads(json.dumps(settings.to_dict())):
                raise DamagedCell(card_path, "its settings are not those of its name")
            return Cell(settings, Examination(card["metrics"], *(arrays[name] for name in _ARRAYS)), card["code"])
        except (json.JSONDecodeError, KeyError, TypeError, OSError, SafetensorError) as error:
            raise DamagedCell(card_path, f"{type(error).__name__}: {error}") from error

    def write(self, settings: CellSettings, result: Examination, code: str) -> None:
        """Keep a cell; its card comes last and whole, so that a kill leaves no half of one."""
        self.path.mkdir(parents=True, exist_ok=True)
        card_path, arrays_path = self._paths(settings)
        card = {
            "format_version": FORMAT_VERSION,
            "settings": asdict(settings),
            "metrics": dict(result.metrics),
            "code": code,
        }
        atomic_write(arrays_path, save({name: getattr(result, name) for name in _ARRAYS}))
        atomic_write(card_path, (json.dumps(card, indent=1, sort_keys=True, allow_nan=False) + "\n").encode())

    def _paths(self, settings: CellSettings) -> tuple[Path, Path]:
        return self.path / f"{settings.key}.json", self.path / f"{settings.key}.safetensors"


@cache
def code_fingerprint() -> str:
    """A short name for the state of the code that trains and judges.

    It is recorded with a cell, and no part of its key: a corrected docstring would else undo a night's work. The
    table says when its cells come from several states.
    """
    digest = hashlib.sha256()
    for package in (mapt.preferences, mapt.rewards):
        for path in sorted(Path(package.__path__[0]).rglob("*.py")):
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:_KEY_LENGTH_SHOWN]


@dataclass(frozen=True, slots=True)
class CellJob:
    """A cell to make."""

    settings: CellSettings
    #: folder of the replay it is made from
    replay: Path
    #: where the trained model is kept; None lets it go
    model: Path | None = None


def make_cell(cells: Path, job: CellJob, parent: ParentConnection) -> None:
    """Make a cell into the folder `cells`, unless it is no longer wanted; `run_jobs` has a worker do it."""
    replay, code = Replay.open(job.replay), _code()
    result = run_cell(job.settings, replay, parent.cancelled, partial(_keep, job.model, replay.source.n_steps))
    if result is not None:
        CellFolder(cells).write(job.settings, result, code)


@cache
def _code() -> str:
    """Of the files as the worker that calls this first has loaded them."""
    return code_fingerprint()


def _keep(folder: Path | None, segment_steps: int, trained: TrainedReward) -> None:
    if folder is not None:
        save_reward_model(trained.model, trained.metrics, segment_steps=segment_steps).write(folder)


#: before a setting of the training; all others are the network's
TRAINING_PREFIX = "train."


def network_of(model: str, preset: PresetName, segments: SegmentLayout) -> RewardConfig:
    """The network of `model` for segments of these dimensions.

    Args:
        model: a name of `MODEL_NAMES`, or one with settings: `MAPT:markov_path=false`.

    Raises:
        InvalidConfig: if there is no such model, or a setting is unknown or out of its range.
    """
    written = Written.parse(model)
    named = RewardConfig.named(
        written.name,
        preset,
        observation_dim=segments.observation_dim,
        action_dim=segments.action_dim,
        n_agents=segments.n_agents,
        discrete_actions=segments.discrete,
    )
    own = {key: value for key, value in written.settings.items() if not key.startswith(TRAINING_PREFIX)}
    return RewardConfig.from_dict(named.to_dict() | own)


def training_of(model: str, preset: PresetName, seed: int, device: str) -> TrainConfig:
    """The training of `model`: the preset's, but for its settings after `train.`, as in `MAPT:train.lr=1e-3`.

    Raises:
        InvalidConfig: if a setting is unknown or out of its range.
    """
    own = {
        key.removeprefix(TRAINING_PREFIX): value
        for key, value in Written.parse(model).settings.items()
        if key.startswith(TRAINING_PREFIX)
    }
    return TrainConfig.from_dict(TrainConfig.preset(preset).to_dict() | own | {"seed": seed, "device": device})


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
                raise InvalidConfig(f"{name} must be at least one, each once; got {', '.join(map(str, values))!r}")
        if min(self.labels) < 2 or min(self.seeds) < 0 or self.test_pairs < 1:
            raise InvalidConfig("labels must be 2 or more, seeds 0 or more, test pairs 1 or more")
        if self.baseline not in self.models:
            raise InvalidConfig(f"the baseline {self.baseline!r} is none of the models: {', '.join(self.models)}")


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
        InvalidConfig, UnknownTeacher, InvalidTeacher: if a model, teacher or setting is unknown, or a
            replay does not fit.
    """
    for replay in replays.values():
        if replay.origin.get("task") != plan.task:
            raise InvalidConfig(f"the replay in {replay.path} is of {replay.origin.get('task')}, not of {plan.task}")
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
