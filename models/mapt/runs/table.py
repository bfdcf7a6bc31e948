"""Runs as a Markdown table: returns by algorithm, reward and steps, and where the time went."""

from collections.abc import Sequence

import numpy as np

from mapt.runs.results import PARTS, Evaluated, Group, RunResult

_NONE = "-"


def markdown(groups: Sequence[Group], milestones: Sequence[int] = ()) -> str:
    """Both tables, and which runs are not there yet.

    Args:
        milestones: steps to tell of; without any, each group's last evaluation.
    """
    lines = [
        "True return of mean actions. Mean and sample standard deviation are over seeds, each seed's value the mean "
        "over its episodes. The interquartile mean is of a seed's episodes, averaged over seeds.",
        "",
        "| task | algorithm | reward | steps | seeds | mean | spread | interquartile mean | by seed |",
        "|---|---|---|---:|---:|---:|---:|---:|---|",
        *(line for group in groups for line in _returns(group, milestones)),
        "",
        "| task | algorithm | reward | steps/s | " + " | ".join(PARTS) + " |",
        "|---|---|---|---:|" + "---:|" * len(PARTS),
        *(line for group in groups if (line := _times(group))),
    ]
    unfinished = [line for group in groups for run in group.runs if (line := _unfinished(group, run))]
    return "\n".join([*lines, *(["", "Not finished:", "", *unfinished] if unfinished else [])]) + "\n"


def _returns(group: Group, milestones: Sequence[int]) -> list[str]:
    if milestones:
        return [_row(group, steps, [(run, run.evaluated_at(steps)) for run in group.runs]) for steps in milestones]
    steps = max((run.evaluations[-1].steps for run in group.runs if run.evaluations), default=0)
    return [_row(group, steps, [(run, run.evaluated_at(steps)) for run in group.runs])]


def _row(group: Group, steps: int, found: Sequence[tuple[RunResult, Evaluated | None]]) -> str:
    there = [(run, one) for run, one in found if one is not None]
    values = np.array([one.mean for _, one in there])
    spread = _whole(values.std(ddof=1)) if len(values) > 1 else _NONE
    mean, iqm = (_whole(values.mean()), _whole(np.mean([one.iqm for _, one in there]))) if there else (_NONE, _NONE)
    each = ", ".join(f"{run.settings.policy.seed}: {_whole(one.mean)}" for run, one in there) or _NONE
    cells = [*_names(group), f"{steps:,}", str(len(values)), mean, spread, iqm, each]
    return f"| {' | '.join(cells)} |"


def _whole(value: np.floating | float) -> str:
    """Without a sign where it is 0."""
    return f"{round(float(value)):,}"


def _times(group: Group) -> str | None:
    seconds = {part: sum(run.seconds[part] for run in group.runs) for part in PARTS}
    total, steps = sum(seconds.values()), sum(run.steps for run in group.runs)
    if not total:
        return None
    cells = [*_names(group), f"{steps / total:,.0f}", *(f"{seconds[part] / total:.0%}" for part in PARTS)]
    return f"| {' | '.join(cells)} |"


def _names(group: Group) -> list[str]:
    algorithm = f"{group.algorithm} ({group.differs})" if group.differs else group.algorithm
    return [group.task, algorithm, group.reward]


def _unfinished(group: Group, run: RunResult) -> str | None:
    if run.steps >= run.settings.steps and run.evaluations:
        return None
    seed = run.settings.policy.seed
    return f"- {group.task}, {group.label}, seed {seed}: {run.steps:,} of {run.settings.steps:,} steps"
