"""A model examined on fresh pairs: segments of a replay that no pair to learn from holds."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapt.rewards.metrics import rank_correlation
from mapt.rewards.model import RewardModel
from mapt.studies.judging import Judge
from mapt.studies.pairs import IntArray, fresh_pairs, split_replay
from mapt.studies.quality import predict, preference_quality, reward_quality
from mapt.studies.replay import Replay

#: added to a seed: the teacher's chance on the fresh pairs is not that on the pairs to learn from
_FRESH_SEED = 1_000_000


@dataclass(frozen=True, slots=True)
class Examination:
    """What a model says of P fresh pairs, and how good that is."""

    #: `accuracy` in telling the segment that is better by what the teacher judges by; `label_accuracy`, `loss` and
    #: `ece` against the labels it gives, with its mistakes, skips and ties; `rank_correlation_teacher` of scores with
    #: what it judges by; those of `reward_quality`. What cannot be measured is left out
    metrics: Mapping[str, float]
    #: score_0 - score_1, float32 (P,)
    logits: NDArray[np.float32]
    #: the teacher's, NaN where it skips, and what it would say without chance; float32 (P,)
    labels: NDArray[np.float32]
    clean_labels: NDArray[np.float32]
    #: which segments of the replay, int64 (P, 2)
    pairs: IntArray


def examine(model: RewardModel, replay: Replay, teacher: str, n_pairs: int, seed: int) -> Examination:
    """Examine `model` on fresh pairs.

    Args:
        teacher: see `Judge`.
        seed: the one of the pairs that it has learned from, which decides what segments are fresh.
    """
    fresh, pairs = split_replay(len(replay), seed).test, fresh_pairs(len(replay), n_pairs, seed)
    judge = Judge(teacher, replay, seed + _FRESH_SEED)
    labels, judged_by = judge.labels(pairs), judge.scores(fresh)
    predictions = predict(model, replay.segments(fresh))
    place = np.searchsorted(fresh, pairs)
    logits = np.subtract(*predictions.scores[place].T)
    clean = (0.5 + 0.5 * np.sign(np.subtract(*judged_by[place].T))).astype(np.float32)
    by_labels = preference_quality(logits, labels)
    metrics = {
        "accuracy": preference_quality(logits, clean)["accuracy"],
        "label_accuracy": by_labels["accuracy"],
        "loss": by_labels["loss"],
        "ece": by_labels["ece"],
        "rank_correlation_teacher": rank_correlation(predictions.scores, judged_by),
        **reward_quality(predictions, replay.rewards[fresh], replay.mask[fresh]),
    }
    measured = {name: value for name, value in metrics.items() if math.isfinite(value)}
    return Examination(measured, logits, labels, clean, pairs)
