"""What an experiment has cost: labels, people's time, and the time of machines."""

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from accord.services import experiments
from accord.store import costs, metrics, rewards
from accord.store.tables import MetricRow


@dataclass(frozen=True, slots=True)
class Costs:
    """What an experiment has cost so far."""

    #: labels and skips that people gave in the page, and their number
    person_answers: int
    people: int
    #: sum of the times from the start of both clips to the answer
    person_seconds: float
    #: labels that programs gave
    program_labels: int
    #: collecting, relabelling and updating, without waiting and evaluations
    policy_seconds: float
    #: training of reward versions, without ensembles
    reward_seconds: float
    #: stored arrays and clips
    segments: int
    clips: int
    clip_bytes: int


def costs_of(session: Session, experiment_id: str) -> Costs:
    """Raises ExperimentNotFound."""
    row = experiments.get(session, experiment_id)
    answers = costs.answers(session, experiment_id, since=row.created_at)
    clips, clip_bytes = costs.clips(session, experiment_id)
    versions = rewards.versions(session, experiment_id)
    return Costs(
        person_answers=answers.by_people,
        people=answers.people,
        person_seconds=answers.person_seconds,
        program_labels=answers.by_programs,
        policy_seconds=_policy_seconds(metrics.points(session, experiment_id, ["steps_per_second"], 0)),
        reward_seconds=sum(float(version.metrics.get("seconds") or 0.0) for version in versions),
        segments=costs.segments(session, experiment_id),
        clips=clips,
        clip_bytes=clip_bytes,
    )


def _policy_seconds(speeds: Sequence[MetricRow]) -> float:
    """Sum of the durations of all iterations: their steps divided by their speed."""
    before = [0, *(point.step for point in speeds)]
    return sum(
        (point.step - last) / point.value for last, point in zip(before, speeds, strict=False) if point.value > 0
    )
