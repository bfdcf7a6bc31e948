"""Pairs to learn from and pairs to test on, from segments that the two never share."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mapt.benchmarks.recorded_dataset import Replay
from mapt.benchmarks.specification import Written
from mapt.errors import InvalidConfig, TooFewLabels
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.preferences.teachers import ScriptedTeacher, TeacherView, make_teacher
from mapt.rewards.data import EVALUATION_SEGMENTS
from mapt.rewards.metrics import correlation, evaluate_logits, rank_correlation
from mapt.rewards.model import RewardModel

IntArray = NDArray[np.int64]
#: what part of a replay is kept for testing, and the most segments
TEST_SHARE, MOST_TEST_SEGMENTS = 0.2, 1000


@dataclass(frozen=True, slots=True)
class Split:
    """Indices of a replay's segments, each in the order they were made."""

    train: IntArray
    test: IntArray


def split_replay(n_segments: int, seed: int) -> Split:
    """Keep some segments, drawn at random, for testing alone.

    Raises:
        InvalidConfig: with fewer than 10 segments.
    """
    if n_segments < 10:
        raise InvalidConfig(f"a replay of {n_segments} segments is too small to split; it needs 10")
    n_test = min(MOST_TEST_SEGMENTS, round(TEST_SHARE * n_segments))
    order = np.random.default_rng([seed, 0]).permutation(n_segments)
    return Split(np.sort(order[n_test:]), np.sort(order[:n_test]))


def random_pairs(pool: IntArray, n_pairs: int, rng: np.random.Generator) -> IntArray:
    """(P, 2) pairs of different segments of `pool`, uniformly; a longer draw begins with the shorter one."""
    first, second = rng.random((n_pairs, 2)).T
    first = (first * len(pool)).astype(np.int64)
    second = (second * (len(pool) - 1)).astype(np.int64)
    second += second >= first
    return np.stack([pool[first], pool[second]], axis=1)


def training_pairs(n_segments: int, n_pairs: int, seed: int) -> IntArray:
    """Pairs (P, 2) of segments to learn from."""
    return random_pairs(split_replay(n_segments, seed).train, n_pairs, np.random.default_rng([seed, 1]))


def fresh_pairs(n_segments: int, n_pairs: int, seed: int) -> IntArray:
    """Pairs (P, 2) of segments to test on."""
    return random_pairs(split_replay(n_segments, seed).test, n_pairs, np.random.default_rng([seed, 2]))


#: give up on a teacher that skips more than this many pairs for each it labels
_MOST_SKIPS_PER_LABEL = 20
#: a teacher looks at so many segments at once, so that memory does not grow with the labels
_SEGMENTS_AT_ONCE = 1000


class Judge:
    """A scripted teacher who looks at segments of one replay.

    Args:
        teacher: a name of `teacher_names`, or one with parameters: `phase+mistake:mistake=0.05`.
        seed: of what it does by chance.

    Raises:
        UnknownTeacher, InvalidTeacher: if there is none such.
    """

    def __init__(self, teacher: str, replay: Replay, seed: int) -> None:
        written = Written.parse(teacher)
        self.name = teacher
        self._teacher: ScriptedTeacher = make_teacher(written.name, seed=seed, **written.settings)
        self._replay = replay

    def parameters(self) -> Mapping[str, object]:
        """Everything that decides its labels, fit for JSON."""
        return self._teacher.parameters()

    def labels(self, pairs: IntArray) -> NDArray[np.float32]:
        """P(segment 0 preferred) of pairs (P, 2), (P,); NaN where it skips."""
        parts = np.array_split(pairs, max(1, 2 * len(pairs) // _SEGMENTS_AT_ONCE))
        sides = ((self._evidence(part[:, 0]), self._evidence(part[:, 1])) for part in parts)
        return np.concatenate([self._teacher.judge(first, second) for first, second in sides])

    def scores(self, indices: IntArray) -> NDArray[np.float64]:
        """What it judges these segments by, without mistakes or doubt, (S,)."""
        parts = np.array_split(indices, max(1, len(indices) // _SEGMENTS_AT_ONCE))
        return np.concatenate([self._teacher.scores(self._evidence(part)) for part in parts])

    def _evidence(self, indices: IntArray) -> TeacherView:
        """These segments, as much of them as the teacher reads."""
        replay, reads = self._replay, self._teacher.rule.reads
        seen: dict[str, NDArray[np.floating]] = {}
        if {"observations", "actions"} & set(reads):
            segments = replay.segments(indices)
            seen = {"observations": segments.observations, "actions": segments.actions}
        for name, read in (("qpos", replay.source.qpos), ("qvel", replay.source.qvel)):
            if name in reads:
                seen[name] = read(indices)
        return TeacherView(replay.rewards[indices], replay.mask[indices], **seen)


def labelled_dataset(judge: Judge, replay: Replay, n_labels: int, seed: int) -> PreferenceDataset:
    """Exactly `n_labels` labelled pairs of segments to learn from; those skipped are replaced by further ones.

    Raises:
        TooFewLabels: if the teacher skips nearly everything.
    """
    labels = np.empty(0, np.float32)
    pairs = np.empty((0, 2), np.int64)
    while (given := int(np.isfinite(labels).sum())) < n_labels:
        if len(labels) > _MOST_SKIPS_PER_LABEL * n_labels:
            raise TooFewLabels(judge.name, n_labels, given)
        more = training_pairs(len(replay), len(labels) + n_labels - given, seed)[len(labels) :]
        pairs, labels = np.concatenate((pairs, more)), np.concatenate((labels, judge.labels(more)))
    kept = np.flatnonzero(np.isfinite(labels))
    used, positions = np.unique(pairs[kept], return_inverse=True)
    return PreferenceDataset(replay.view(used), positions.reshape(-1, 2), labels[kept])


#: what part of the test segments, the newest, counts as late
LATE_SHARE = 0.2


@dataclass(frozen=True, slots=True)
class Predictions:
    """What a model says of S segments."""

    #: float32 (S,)
    scores: NDArray[np.float32]
    #: r-hat, float32 (S, T, N)
    agent_rewards: NDArray[np.float32]
    #: how much each step counts, float32 (S, T)
    weights: NDArray[np.float32]

    @property
    def rewards(self) -> NDArray[np.float32]:
        """r-hat of the team, (S, T): the mean over agents."""
        return self.agent_rewards.mean(axis=2)


@torch.inference_mode()
def predict(model: RewardModel, segments: SegmentArrays) -> Predictions:
    """Run `model`, on the CPU, over segments, some at a time."""
    arrays = (segments.observations, segments.actions, segments.mask)
    parts = zip(*(torch.as_tensor(array).split(EVALUATION_SEGMENTS) for array in arrays), strict=True)
    outputs = [model(*part) for part in parts]
    return Predictions(
        torch.cat([output.score for output in outputs]).numpy(),
        torch.cat([output.agent_rewards for output in outputs]).numpy(),
        torch.cat([output.weights for output in outputs]).numpy(),
    )


def preference_quality(logits: NDArray[np.floating], labels: NDArray[np.floating]) -> dict[str, float]:
    """`accuracy`, `loss` (nats) and `ece` of predicted logits (P,) against labels (P,), NaN where skipped."""
    given = np.isfinite(labels)
    judged = evaluate_logits(torch.as_tensor(logits[given]).double(), torch.as_tensor(labels[given]).double())
    return {"accuracy": judged.accuracy, "loss": judged.loss, "ece": judged.calibration_error}


def reward_quality(
    predictions: Predictions, true_rewards: NDArray[np.floating], mask: NDArray[np.bool_]
) -> dict[str, float]:
    """Agreement with the true reward (S, T) of segments in the order they were made; mask (S, T).

    Returns:
        `rank_correlation` of scores and true returns (Spearman), `step_correlation` of r-hat_t and the true reward
        over all real steps (Pearson), `step_correlation_within` after taking each segment's mean away from both, and
        `rank_correlation_late` and `step_correlation_late` over the newest fifth.
    """
    true = np.where(mask, true_rewards, 0.0)
    learned = np.where(mask, predictions.rewards, 0.0)
    returns, scores = true.sum(axis=1), predictions.scores
    late = slice(round(len(returns) * (1 - LATE_SHARE)), None)
    return {
        "rank_correlation": rank_correlation(scores, returns),
        "rank_correlation_late": rank_correlation(scores[late], returns[late]),
        "step_correlation": correlation(learned[mask], true[mask]),
        "step_correlation_within": correlation(_centred(learned, mask)[mask], _centred(true, mask)[mask]),
        "step_correlation_late": correlation(learned[late][mask[late]], true[late][mask[late]]),
    }


def _centred(steps: NDArray[np.floating], mask: NDArray[np.bool_]) -> NDArray[np.floating]:
    return steps - steps.sum(axis=1, keepdims=True) / mask.sum(axis=1, keepdims=True)


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
