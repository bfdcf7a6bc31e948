"""Weights of labels by the estimated reliability of who gave them, for the training of one reward version."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from accord.services.publish import LabellerReliability
from accord.store.labels import GoldLabel, LabelledPair
from accord.store.rewards import NamedReliability
from mapt.preferences.dataset import PreferenceDataset
from mapt.preferences.reliability import EQUAL, LEFT, RIGHT, LabellerAnswers, cross_fitted_logits, estimate_reliability


@dataclass(frozen=True, slots=True)
class WeightedLabels:
    """Labels for training, and what was estimated of their labellers."""

    dataset: PreferenceDataset
    #: empty where all labels are of one labeller
    reliabilities: list[LabellerReliability]


def weight_labels(
    dataset: PreferenceDataset, labels: Sequence[LabelledPair], gold: Sequence[GoldLabel]
) -> WeightedLabels:
    """Weight labels by what they, the labels of gold queries and researchers' decisions tell about their labellers.

    A label that a researcher has decided has weight 1. With one labeller, every label has.

    Args:
        dataset: the labels, one pair each.
        labels: the same labels in the same order.
    """
    users = list(dict.fromkeys(label.user_id for label in labels))
    if len(users) < 2:
        return WeightedLabels(dataset, [])
    # Who has only labelled gold queries has no label to weight.
    gold = [label for label in gold if label.user_id in users]
    numbers = list(dict.fromkeys(label.query_number for label in [*labels, *gold]))
    pair_of = {number: index for index, number in enumerate(numbers)}
    answers = LabellerAnswers(
        np.array([pair_of[label.query_number] for label in [*labels, *gold]]),
        np.array([*(label.given for label in labels), *(label.value for label in gold)], dtype=np.float32),
        np.array([users.index(label.user_id) for label in [*labels, *gold]]),
        np.array([label.left_segment or 0 for label in [*labels, *gold]]),
    )
    logits, known = np.full(len(numbers), np.nan), np.full(len(numbers), np.nan)
    logits[answers.pairs[: len(labels)]] = cross_fitted_logits(dataset)
    decisions = [(label.query_number, label.value) for label in labels if label.decided]
    for number, value in [*decisions, *((label.query_number, label.known) for label in gold)]:
        # Two segments that are known to be equal do not tell who prefers the better one.
        known[pair_of[number]] = math.nan if value == 0.5 else value
    found = estimate_reliability(answers, len(users), logits, known)
    decided = np.array([label.decided for label in labels])
    weights = np.where(decided, 1.0, found.weights[: len(labels)])
    labellers = answers.labellers[: len(labels)]
    reliabilities = [
        LabellerReliability(
            user_id=user,
            labels=int((labellers == index).sum()),
            accuracy=float(found.accuracy[index]),
            left_weight=float(found.answer_weights[index, LEFT]),
            equal_weight=float(found.answer_weights[index, EQUAL]),
            right_weight=float(found.answer_weights[index, RIGHT]),
            mean_weight=float(weights[labellers == index].mean()),
        )
        for index, user in enumerate(users)
    ]
    return WeightedLabels(dataset.weighted(weights), reliabilities)


def weights_of_version(
    dataset: PreferenceDataset, labels: Sequence[LabelledPair], reliabilities: Sequence[NamedReliability]
) -> PreferenceDataset:
    """Weight labels as those of a published version were.

    Args:
        dataset, labels: as in `weight_labels`.
        reliabilities: of the version; empty where its labels were not weighted.
    """
    by_user = {each.row.user_id: each.row for each in reliabilities}
    weight: Mapping[str, Mapping[float, float]] = {
        user: {1.0: row.left_weight, 0.5: row.equal_weight, 0.0: row.right_weight} for user, row in by_user.items()
    }

    def of(label: LabelledPair) -> float:
        if label.decided or label.user_id not in weight:
            return 1.0
        prefers_left = label.given if not label.left_segment else 1 - label.given
        return weight[label.user_id][0.5 + 0.5 * np.sign(prefers_left - 0.5)]

    return dataset.weighted([of(label) for label in labels])
