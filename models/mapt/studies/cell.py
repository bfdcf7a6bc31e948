"""One cell of a table: a model trained on so many labels of one teacher, with one seed, and what came of it."""

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace

from mapt.rewards.config import RewardConfig
from mapt.rewards.model import RewardModel
from mapt.rewards.train_config import TrainConfig
from mapt.rewards.trainer import TrainedReward, train_reward_model
from mapt.studies.examination import Examination, examine
from mapt.studies.judging import Judge, labelled_dataset
from mapt.studies.replay import Replay


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
