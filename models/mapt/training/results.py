"""Runs read back from disk and compared: groups over seeds, curves, Markdown tables."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import RunNotFound
from mapt.training.metrics import Metrics, read_metrics
from mapt.training.run_folder import RUN_FILE, RunFolder
from mapt.training.settings import TRUE, RunSettings

#: parts of a curve, in each of which a seed's points are averaged: more cannot be told apart
MOST_BINS = 150


class Curve(Protocol):
    """Returns of the episodes of one run, by the steps at which they ended."""

    @property
    def curve_steps(self) -> NDArray[np.int64]:
        """(P,), in order."""
        ...

    @property
    def curve_returns(self) -> NDArray[np.float64]:
        """(P,)."""
        ...


@dataclass(frozen=True, slots=True)
class SeedCurves:
    """Curves of several seeds at the same steps."""

    #: (B,)
    steps: NDArray[np.float64]
    #: (seeds, B); NaN outside of what a seed has seen
    returns: NDArray[np.float64]

    def whole(self) -> NDArray[np.bool_]:
        """(B,): where every seed has a value; elsewhere a mean would jump where a seed ends."""
        return np.all(np.isfinite(self.returns), axis=0, keepdims=True)[0]


def seed_curves(runs: Sequence[Curve], most_bins: int = MOST_BINS) -> SeedCurves:
    """Means of each run's points by bins of steps; a bin without points lies on the line between its neighbours."""
    points = max(len(run.curve_steps) for run in runs)
    last = max(int(run.curve_steps[-1]) for run in runs if len(run.curve_steps))
    edges = np.linspace(0, last, min(points, most_bins) + 1)
    # Binned alike, steps at the bins' ends and returns belong together for all seeds.
    return SeedCurves(edges[1:], np.stack([_binned(run, edges) for run in runs]))


def deviation(returns: ArrayLike) -> NDArray[np.float64]:
    """Sample standard deviation over the first axis, the seeds; 0 of a single one."""
    values = np.asarray(returns, dtype=np.float64)
    return np.asarray(values.std(axis=0, ddof=min(1, len(values) - 1)))


def _binned(run: Curve, edges: NDArray[np.float64]) -> NDArray[np.float64]:
    values = np.full(len(edges) - 1, np.nan)
    if not len(run.curve_steps):
        return values
    place = np.clip(np.searchsorted(edges, run.curve_steps, side="left") - 1, 0, len(values) - 1)
    counts = np.bincount(place, minlength=len(values))
    sums = np.bincount(place, run.curve_returns, minlength=len(values))
    filled = np.flatnonzero(counts)
    between = np.arange(filled[0], filled[-1] + 1)
    values[between] = np.interp(between, filled, sums[filled] / counts[filled])
    return values


#: settings in which the runs of one line of a picture may differ
_FREE = frozenset({"policy.seed", "policy.device", "policy.n_threads", "steps", "evaluate_every_steps"})
#: where the time of an iteration goes
PARTS = ("physics", "inference", "reward", "update")


@dataclass(frozen=True, slots=True)
class Evaluated:
    """Mean actions after some steps."""

    steps: int
    #: mean and interquartile mean over the episodes
    mean: float
    iqm: float


@dataclass(frozen=True, slots=True)
class RunResult:
    """What one run has come to."""

    settings: RunSettings
    #: environment steps so far
    steps: int
    #: (P,) steps, and true return of the episodes that ended there while training
    curve_steps: NDArray[np.int64]
    curve_returns: NDArray[np.float64]
    #: in order of their steps
    evaluations: tuple[Evaluated, ...]
    #: seconds by part, over the whole run
    seconds: dict[str, float]

    @classmethod
    def read(cls, folder: RunFolder) -> "RunResult":
        """The run in a folder, trained to its end or not.

        Raises:
            DamagedRun: if a file of it cannot be read.
        """
        settings, lines = folder.settings(), read_metrics(folder.metrics)
        steps = int(lines[-1]["steps"]) if lines else 0
        points = [(int(line["steps"]), float(line["true_return"])) for line in lines if "true_return" in line]
        evaluations = {line["steps"]: _evaluated(line) for line in lines if "evaluation_mean" in line}
        final = folder.read_evaluation(steps)
        if final is not None:
            found = final.summary()
            evaluations[steps] = Evaluated(steps, found["mean"], found["iqm"])
        return cls(
            settings,
            steps,
            np.array([step for step, _ in points], dtype=np.int64),
            np.array([value for _, value in points]),
            tuple(evaluations.values()),
            {part: sum(float(line[f"seconds_{part}"]) for line in lines) for part in PARTS},
        )

    def evaluated_at(self, steps: int) -> Evaluated | None:
        """The first evaluation from so many steps on, if it came within a twentieth of them or a rollout."""
        late = max(steps // 20, self.settings.policy.steps_per_rollout)
        return next((one for one in self.evaluations if steps <= one.steps < steps + late), None)


def _evaluated(line: Metrics) -> Evaluated:
    return Evaluated(int(line["steps"]), float(line["evaluation_mean"]), float(line["evaluation_iqm"]))


@dataclass(frozen=True, slots=True)
class Group:
    """Runs that differ in their seeds alone."""

    task: str
    algorithm: str
    #: `true`, or the reward model's name
    reward: str
    #: settings in which it differs from others of the same task, algorithm and reward
    differs: str
    runs: tuple[RunResult, ...]

    @property
    def label(self) -> str:
        """What it is called beside others of its task."""
        reward = "true reward" if self.reward == TRUE else self.reward
        return ", ".join(part for part in (self.algorithm, reward, self.differs) if part)


def find_runs(paths: Iterable[Path]) -> list[RunFolder]:
    """Runs at these paths or anywhere below them, each once.

    Raises:
        RunNotFound: if there is none at one of them.
    """
    found: dict[Path, RunFolder] = {}
    for path in paths:
        folders = sorted(file.parent for file in path.rglob(RUN_FILE))
        if not folders:
            raise RunNotFound(path)
        found |= {folder.resolve(): RunFolder(folder) for folder in folders}
    return list(found.values())


def grouped(runs: Sequence[RunResult]) -> list[Group]:
    """Groups in the order of their first runs."""
    by_settings: dict[tuple[tuple[str, str], ...], list[RunResult]] = {}
    for run in runs:
        by_settings.setdefault(_fixed(run.settings), []).append(run)
    return [
        Group(*_name(members[0]), differs=_differences(key, _name(members[0]), by_settings), runs=tuple(members))
        for key, members in by_settings.items()
    ]


def _fixed(settings: RunSettings) -> tuple[tuple[str, str], ...]:
    flat = settings.flat()
    return tuple(sorted((name, str(value)) for name, value in flat.items() if name not in _FREE))


def _name(run: RunResult) -> tuple[str, str, str]:
    settings = run.settings
    reward = settings.reward_name if settings.reward is None else Path(settings.reward.path).stem
    return settings.task, settings.policy.algorithm, reward


def _differences(
    own: tuple[tuple[str, str], ...],
    name: tuple[str, str, str],
    others: dict[tuple[tuple[str, str], ...], list[RunResult]],
) -> str:
    """The settings in which groups of the same name differ, as this one has them."""
    alike = [dict(key) for key, members in others.items() if _name(members[0]) == name]
    varying = [setting for setting, _ in own if len({each.get(setting) for each in alike}) > 1]
    return ", ".join(f"{setting.removeprefix('policy.')}={dict(own)[setting]}" for setting in varying)


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
