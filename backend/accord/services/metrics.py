"""Curves of an experiment."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from accord.domain.enums import Role
from accord.domain.permissions import may_see_returns
from accord.services.experiments import config_of
from accord.store import experiments, metrics
from accord.store.tables import ExperimentRow, MetricRow

#: what labellers never get; neither do they get anything that begins with `true_`
TRUE_SERIES = frozenset({"true_return"})
_TRUE_PREFIX = "true_"
#: what these would tell of the true reward where it is the policy's reward
_TRUE_WHEN_TAUGHT_BY_IT = frozenset({"learned_return", "value_loss"})
#: what a labeller may know of a reward version; rank correlation, for one, is computed from true returns
_OPEN_VERSION_METRICS = frozenset({"loss", "accuracy", "holdout_loss", "holdout_accuracy", "ece", "seconds", "epochs"})


@dataclass(frozen=True, slots=True)
class Series:
    """One curve, or its newest part."""

    name: str
    points: list[MetricRow]


def record(
    session: Session,
    experiment_id: str,
    step: int,
    values: Mapping[str, float],
    reward_version_id: str | None = None,
) -> None:
    """Writes one point on each named curve, in place of one at the same step; leaves out what is not finite."""
    finite = {name: float(value) for name, value in values.items() if math.isfinite(value)}
    if not finite:
        return
    # In Postgres, ids of two writers could be committed out of order, and a live page would miss the lower one.
    experiments.lock(session, experiment_id)
    metrics.replace(session, experiment_id, step, finite, reward_version_id)


def series(session: Session, experiment_id: str, names: Sequence[str] | None = None, after_id: int = 0) -> list[Series]:
    """Curves by name, each by step; with `after_id`, only points written after the one with this id."""
    curves: dict[str, list[MetricRow]] = {}
    for point in metrics.points(session, experiment_id, names, after_id):
        curves.setdefault(point.name, []).append(point)
    return [Series(name, points) for name, points in curves.items()]


def visible(found: Sequence[Series], experiment: ExperimentRow, role: Role) -> list[Series]:
    """Those curves that a role may see."""
    if may_see_returns(role):
        return list(found)
    taught_by_truth = config_of(experiment).reward_source == "true"
    return [
        curve
        for curve in found
        if curve.name not in TRUE_SERIES
        and not curve.name.startswith(_TRUE_PREFIX)
        and not (taught_by_truth and curve.name in _TRUE_WHEN_TAUGHT_BY_IT)
    ]


def visible_version_metrics(found: Mapping[str, object], role: Role) -> dict[str, object]:
    """Those metrics of a reward version that a role may see."""
    if may_see_returns(role):
        return dict(found)
    return {name: value for name, value in found.items() if name in _OPEN_VERSION_METRICS}
