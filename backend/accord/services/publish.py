"""Reward versions: what they are trained on, and their publication. A version never changes; the next is a new row."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy.orm import Session

from accord.domain.errors import ExperimentNotFound
from accord.domain.ids import new_id
from accord.services import experiments as experiment_service
from accord.store import experiments, labels, rewards
from accord.store.labels import LabelledPair as TrainingLabel
from accord.store.tables import RewardVersionRow

__all__ = [
    "TrainingLabel",
    "TrainingLabels",
    "new_labels",
    "newest",
    "publish",
    "training_labels",
    "version_labels",
    "versions",
]


@dataclass(frozen=True, slots=True)
class TrainingLabels:
    """Every label that counts, as of a revision."""

    items: list[TrainingLabel]
    #: the experiment's label revision: every change up to this one is in `items`, none after it
    watermark: int


def new_labels(session: Session, experiment_id: str, after_revision: int) -> int:
    """Labels that count and were written or changed after a revision; 0 for `after_revision` gives all of them."""
    return labels.count_after(session, experiment_id, after_revision)


def version_labels(session: Session, version: RewardVersionRow) -> list[TrainingLabel]:
    """What a version was trained on, without the labels that were changed or undone since."""
    return labels.up_to(session, version.experiment_id, version.label_watermark)


def training_labels(session: Session, experiment_id: str) -> TrainingLabels:
    """Raises ExperimentNotFound."""
    # The watermark first: a label that comes in between is above it, and belongs to the next version.
    watermark = experiment_service.get(session, experiment_id).label_revision
    return TrainingLabels(labels.up_to(session, experiment_id, watermark), watermark)


def publish(
    session: Session,
    experiment_id: str,
    blob_key: str,
    *,
    label_watermark: int,
    label_count: int,
    policy_steps: int,
    metrics: Mapping[str, float | None],
) -> RewardVersionRow:
    """The next version of an experiment's reward model, child of the newest one. Its blob is stored before.

    Args:
        label_watermark, label_count: what it was trained on, from `training_labels`.
        policy_steps: environment steps of the policy now.
        metrics: loss, accuracy and so on; a number that is not finite is kept as None, for which JSON has a word.

    Raises:
        ExperimentNotFound: if there is no such experiment.
    """
    if experiments.lock(session, experiment_id) is None:
        raise ExperimentNotFound(experiment_id)
    parent = rewards.newest_version(session, experiment_id)
    row = RewardVersionRow(
        id=new_id("rwv"),
        experiment_id=experiment_id,
        number=1 if parent is None else parent.number + 1,
        parent_id=None if parent is None else parent.id,
        label_watermark=label_watermark,
        label_count=label_count,
        policy_steps=policy_steps,
        blob_key=blob_key,
        metrics={
            name: value if value is not None and math.isfinite(value) else None for name, value in metrics.items()
        },
    )
    session.add(row)
    session.flush()
    return row


def newest(session: Session, experiment_id: str) -> RewardVersionRow | None:
    return rewards.newest_version(session, experiment_id)


def versions(session: Session, experiment_id: str) -> list[RewardVersionRow]:
    """Oldest first. Raises ExperimentNotFound."""
    experiment_service.get(session, experiment_id)
    return rewards.versions(session, experiment_id)
