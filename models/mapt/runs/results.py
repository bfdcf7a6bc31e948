"""Finished and unfinished runs, read back to be compared."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapt.runs.errors import RunNotFound
from mapt.runs.folder import RUN_FILE, RunFolder
from mapt.runs.metrics_file import Metrics, read_metrics
from mapt.runs.settings import TRUE, RunSettings

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
