"""When a reward version is due, and when the policy waits: rules over numbers alone, shared by both workers.

Both sides use `threshold`, which is what keeps them from waiting for each other: whenever the labels due are in and the
newest version was trained on too few, that same version is due to be replaced.
"""

from dataclasses import dataclass
from math import ceil

from accord.services.experiment_config import ExperimentConfig


def threshold(config: ExperimentConfig, labels: int) -> int:
    """The number of labels at which the newest version should have been trained, 0 before the first.

    Versions are due at `initial_labels`, every `labels_per_version` after, and at the whole budget.
    """
    if labels < config.initial_labels:
        return 0
    if labels >= config.label_budget:
        return config.label_budget
    passed = (labels - config.initial_labels) // config.labels_per_version
    return config.initial_labels + passed * config.labels_per_version


def version_is_due(config: ExperimentConfig, *, labels: int, trained_on: int, changed: int) -> bool:
    """Whether the reward worker should train.

    Args:
        labels: labels that count now.
        trained_on: labels of the newest version, 0 if there is none.
        changed: labels written, changed or undone since its watermark.
    """
    if labels < min(config.initial_labels, config.label_budget) or changed == 0:
        return False
    if threshold(config, labels) > threshold(config, trained_on):
        return True
    # Second thoughts: a labeller went back over old answers. At the end of the budget every one of them counts.
    return changed >= config.labels_per_version or labels >= config.label_budget


@dataclass(frozen=True, slots=True)
class Progress:
    """What the policy worker knows when it decides whether to wait."""

    #: environment steps trained
    steps: int
    #: labels that count
    labels: int
    #: labels the newest version was trained on; None before the first
    trained_on: int | None
    #: whether every pair of its segments was asked about, and answered: more labels need more segments
    exhausted: bool = False


def waits_for(config: ExperimentConfig, progress: Progress) -> str | None:
    """Why the policy must not train on just now, as a sentence for the page; None when it may."""
    if config.reward_source == "true":
        return None
    due = config.schedule.due(progress.steps)
    if progress.exhausted:
        # It would wait for ever; the next rollout brings segments, and with them the labels that are behind.
        due = min(due, progress.labels)
    if progress.trained_on is None:
        return _missing(progress.labels, config.initial_labels, "the first reward version")
    if config.pacing == "free":
        return None
    if progress.labels < due:
        return _missing(progress.labels, due, "training to go on")
    if threshold(config, progress.trained_on) < threshold(config, due):
        return f"The labels are in; the reward model trains on {progress.labels} of them."
    return None


def cannot_begin(config: ExperimentConfig, progress: Progress) -> str | None:
    """Why the first reward version can never be, once the first rollout was handed in; None where it can."""
    if progress.trained_on is not None or not progress.exhausted or progress.labels >= config.initial_labels:
        return None
    return (
        f"The first rollout's segments make no more pairs than were asked about, which gave {progress.labels} labels; "
        f"initial_labels is {config.initial_labels}. Lower it, or raise policy.n_envs or policy.rollout_steps; where "
        f"episodes end within fewer than segment_steps ({config.segment_steps}), that can be lowered."
    )


def _missing(labels: int, wanted: int, what_for: str) -> str:
    if labels >= wanted:
        return "The labels are in; the reward model trains on them."
    return f"{labels} of {wanted} labels for {what_for}."


def segments_to_hand_in(config: ExperimentConfig, *, iteration: int, rollout_steps: int, fitting: int) -> int:
    """How many segments of this rollout go to the pool.

    Over a run the pool comes to four segments a label, so twice what the labels need: enough to choose among. The
    first rollout gives what the first queries need, at least 64.

    Args:
        iteration: of the policy, from 0.
        rollout_steps: environment steps of one rollout.
        fitting: how many segments that do not overlap the rollout holds.
    """
    if config.reward_source == "true":
        return 0
    first = max(64, 2 * (config.initial_labels + config.lookahead_queries))
    if iteration == 0:
        return min(fitting, first)
    later_rollouts = max(1, ceil(config.total_steps / rollout_steps) - 1)
    return min(fitting, max(2, ceil((4 * config.label_budget - first) / later_rollouts)))
