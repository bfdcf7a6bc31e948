"""What an experiment has cost: labels, people's time, and the time of machines."""

from dataclasses import dataclass

from sqlalchemy.orm import Session

from accord.services import experiments
from accord.store import costs, rewards


@dataclass(frozen=True, slots=True)
class Costs:
    """What an experiment has cost so far."""

    #: labels and skips that people gave in the page, and their number
    person_answers: int
    people: int
    #: sum of the times from the start of both clips to the answer; answers without a measured time are left out
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
    answers = costs.answers(session, experiment_id)
    clips, clip_bytes = costs.clips(session, experiment_id)
    versions = rewards.versions(session, experiment_id)
    steps_per_rollout = experiments.config_of(row).policy_config().steps_per_rollout
    return Costs(
        person_answers=answers.by_people,
        people=answers.people,
        person_seconds=answers.person_seconds,
        program_labels=answers.by_programs,
        policy_seconds=steps_per_rollout * costs.sum_of_inverses(session, experiment_id, "steps_per_second"),
        reward_seconds=sum(float(version.metrics.get("seconds") or 0.0) for version in versions),
        segments=costs.segments(session, experiment_id),
        clips=clips,
        clip_bytes=clip_bytes,
    )
