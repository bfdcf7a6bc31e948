"""One cell of a table: a model trained on so many labels of one teacher, with one seed, and what came of it."""

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mapt.rewards.config import RewardConfig
from mapt.rewards.metrics import rank_correlation
from mapt.rewards.train_config import TrainConfig
from mapt.rewards.trainer import train_reward_model
from mapt.studies.judging import Judge, labelled_dataset
from mapt.studies.pairs import fresh_pairs, split_replay
from mapt.studies.quality import predict, preference_quality, reward_quality
from mapt.studies.replay import Replay

#: added to a seed: the teacher's chance on the fresh pairs is not that on the training pairs
_TEST_SEED = 1_000_000


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


@dataclass(frozen=True, slots=True)
class CellResult:
    """What a cell found."""

    #: see `run_cell`; what cannot be measured is left out
    metrics: Mapping[str, float]
    #: of the fresh pairs, (P,): score_0 - score_1, the teacher's labels (NaN where it skips), and which segment is
    #: better by what it judges by
    logits: NDArray[np.float32]
    labels: NDArray[np.float32]
    clean_labels: NDArray[np.float32]
    #: int64 (P, 2): which segments of the replay
    pairs: NDArray[np.int64]


def run_cell(settings: CellSettings, replay: Replay, stop: Callable[[], bool] | None = None) -> CellResult | None:
    """Label, train, test. None if `stop` came true.

    The metrics, all on fresh pairs of segments that no training pair holds:
        `accuracy` in telling the segment that is better by what the teacher judges by; `label_accuracy`, `loss` and
        `ece` against the labels it gives, mistakes, skips and ties included; `rank_correlation_teacher` of scores
        with what it judges by; those of `reward_quality`;
    and of the training: `train_holdout_accuracy`, `train_holdout_loss`, `epochs`, `seconds`, `cpu_seconds`,
    `parameters`.
    """
    seed = settings.seed
    teacher = Judge(settings.teacher, replay, seed)
    dataset = labelled_dataset(teacher, replay, settings.labels, seed)
    started, started_cpu = time.perf_counter(), time.process_time()
    trained = train_reward_model(
        dataset, RewardConfig.from_dict(settings.network), TrainConfig.from_dict(settings.training), stop=stop
    )
    seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - started_cpu
    if trained.metrics["stopped"]:
        return None
    test = split_replay(len(replay), seed).test
    pairs = fresh_pairs(len(replay), settings.test_pairs, seed)
    labels = Judge(settings.teacher, replay, seed + _TEST_SEED).labels(pairs)
    predictions = predict(trained.model, replay.segments(test))
    judged_by = teacher.scores(test)
    by_place = np.searchsorted(test, pairs)
    logits = np.subtract(*predictions.scores[by_place].T)
    clean = _decide(judged_by, by_place)
    by_labels = preference_quality(logits, labels)
    metrics = {
        "accuracy": preference_quality(logits, clean)["accuracy"],
        "label_accuracy": by_labels["accuracy"],
        "loss": by_labels["loss"],
        "ece": by_labels["ece"],
        **reward_quality(predictions, replay.rewards[test], replay.mask[test]),
        "rank_correlation_teacher": rank_correlation(predictions.scores, judged_by),
        "train_holdout_accuracy": trained.metrics.get("holdout_accuracy", math.nan),
        "train_holdout_loss": trained.metrics.get("holdout_loss", math.nan),
        "epochs": trained.metrics["epochs"],
        "parameters": float(_n_parameters(trained.model)),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
    }
    measured = {name: value for name, value in metrics.items() if math.isfinite(value)}
    return CellResult(measured, logits, labels, clean, pairs)


def _decide(judged_by: NDArray[np.float64], by_place: NDArray[np.int64]) -> NDArray[np.float32]:
    first, second = judged_by[by_place].T
    return (0.5 + 0.5 * np.sign(first - second)).astype(np.float32)


def _n_parameters(model: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in model.parameters() if parameter.requires_grad)
