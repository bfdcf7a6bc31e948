"""What a running experiment waits for, and for how long, computed from its rows.

What the policy worker wrote when it began to wait becomes outdated with the next label, and while the worker trains
another experiment.
"""

from dataclasses import dataclass
from math import ceil
from typing import Literal

from accord.domain.enums import ExperimentStatus, Phase
from accord.services.experiment_config import ExperimentConfig
from accord.services.experiments import LabelCounts, config_of
from accord.store.tables import ExperimentRow, RewardVersionRow
from mapt.errors import InvalidConfig
from mapt.training.schedule import Progress

WaitingFor = Literal["", "policy_worker", "labels", "reward_version"]


@dataclass(frozen=True, slots=True)
class Waiting:
    """What an experiment waits for."""

    #: empty while the policy trains, and unless the experiment is running
    waiting_for: WaitingFor
    #: a sentence for users
    detail: str
    #: Estimated seconds until the reward version is trained, or until the policy that trains needs more labels;
    #: None if unknown, or if there are labels to give.
    seconds: float | None


def waiting(row: ExperimentRow, counts: LabelCounts, newest: RewardVersionRow | None) -> Waiting:
    """What the experiment waits for.

    Args:
        newest: its newest reward version.
    """
    if row.status != ExperimentStatus.RUNNING:
        # Only the reason of a failure is still true.
        return Waiting("", row.phase_detail if row.status == ExperimentStatus.FAILED else "", None)
    if row.phase == Phase.QUEUED:
        return Waiting("policy_worker", "It starts when a policy worker is free.", None)
    config = config_of(row)
    if config.reward_source == "true":
        return Waiting("", row.phase_detail, None)
    schedule = config.schedule
    if row.phase != Phase.WAITING_FOR_LABELS:
        return Waiting("", row.phase_detail, _until_next_query(row, counts, config))
    progress = Progress(row.steps, row.label_count, newest.label_count if newest else None)
    waits_for = schedule.waits_for(progress)
    if waits_for is None:
        return Waiting("policy_worker", "It continues when a policy worker is free.", None)
    seconds = None if waits_for == "labels" or newest is None else newest.metrics.get("seconds")
    return Waiting(waits_for, schedule.waiting_reason(progress) or "", seconds)


def _until_next_query(row: ExperimentRow, counts: LabelCounts, config: ExperimentConfig) -> float | None:
    """Seconds until the end of the rollout after which the next query is due; None if it is due, or unknown."""
    ready = counts.open_queries + counts.rendering_queries
    if ready or not row.steps_per_second:
        return None
    at = config.schedule.next_query_at(row.steps, counts.labels)
    if at is None or at == row.steps:
        return None
    try:
        rollout_steps = config.policy_config().steps_per_rollout
    except InvalidConfig:
        # Another version of Accord stored it; the policy worker will say what is wrong.
        return None
    return ceil((at - row.steps) / rollout_steps) * rollout_steps / row.steps_per_second
