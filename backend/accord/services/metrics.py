"""Metrics of an experiment over the policy's steps."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from accord.domain.enums import Role
from accord.domain.permissions import may_see_returns
from accord.services.experiments import config_of
from accord.store import experiments, metrics
from accord.store.tables import ExperimentRow, MetricRow

#: labellers do not get curves whose names begin with this
_TRUE_PREFIX = "true_"
#: also hidden from labellers if the policy learns from the true reward, which these would reveal
_TRUE_IF_LEARNED_FROM = frozenset({"learned_return", "value_loss"})
#: metrics of a reward version that labellers may see; rank correlation, for example, reveals true returns
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
    """Writes one point of each curve, replacing one at the same step; skips values that are not finite."""
    finite = {name: float(value) for name, value in values.items() if math.isfinite(value)}
    if not finite:
        return
    # Without the lock, Postgres could commit the ids of two writers out of order, and live events would miss one.
    experiments.lock(session, experiment_id)
    metrics.replace(session, experiment_id, step, finite, reward_version_id)


def series(session: Session, experiment_id: str, names: Sequence[str] | None = None, after_id: int = 0) -> list[Series]:
    """Curves sorted by name and step; only points written after the one with id `after_id`."""
    curves: dict[str, list[MetricRow]] = {}
    for point in metrics.points(session, experiment_id, names, after_id):
        curves.setdefault(point.name, []).append(point)
    return [Series(name, points) for name, points in curves.items()]


def visible(found: Sequence[Series], experiment: ExperimentRow, role: Role) -> list[Series]:
    """The curves that a role may see."""
    if may_see_returns(role):
        return list(found)
    learns_true_reward = config_of(experiment).reward_source == "true"
    return [
        curve
        for curve in found
        if not curve.name.startswith(_TRUE_PREFIX) and not (learns_true_reward and curve.name in _TRUE_IF_LEARNED_FROM)
    ]


def visible_version_metrics(found: Mapping[str, object], role: Role) -> dict[str, object]:
    """The metrics of a reward version that a role may see."""
    if may_see_returns(role):
        return dict(found)
    return {name: value for name, value in found.items() if name in _OPEN_VERSION_METRICS}
