"""The metrics of each iteration: computed, written to metrics.jsonl, exported to TensorBoard."""

import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tensorboardX import SummaryWriter

from mapt.errors import DamagedRun
from mapt.policies import Rollout
from mapt.rewards.metrics import correlation

#: what differs from run to run of the same settings; everything else is decided by them
TIMINGS = ("time", "steps_per_second", "seconds_physics", "seconds_inference", "seconds_reward", "seconds_update")

Metrics = dict[str, float | str]


class MetricsFile:
    """The lines of a run, from the checkpoint on that it goes on from.

    Args:
        path: made when missing.
        lines: of the checkpoint; those after them, written by a process that was killed since, are made again.

    Raises:
        DamagedRun: if there are fewer.
    """

    def __init__(self, path: Path, lines: int) -> None:
        path.touch()
        self._file = path.open("r+b")
        for _ in range(lines):
            if not self._file.readline().endswith(b"\n"):
                self._file.close()
                raise DamagedRun(path, f"it has fewer than the {lines} lines of the run's checkpoint")
        self._file.seek(self._file.tell())
        self._file.truncate()

    def append(self, values: Mapping[str, float | str]) -> None:
        """Add a line; another process sees it at once."""
        self._file.write(json.dumps(values).encode() + b"\n")
        self._file.flush()

    def sync(self) -> None:
        """Return when the lines are on disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


def read_metrics(path: Path) -> list[Metrics]:
    """The whole lines of a file; a run that is being trained may be in the middle of its last.

    Raises:
        DamagedRun: if it is missing, or a whole line is no JSON object.
    """
    try:
        lines = path.read_bytes().split(b"\n")[:-1]
        values = [json.loads(line) for line in lines]
    except (OSError, ValueError) as error:
        raise DamagedRun(path, str(error)) from error
    if not all(isinstance(line, dict) for line in values):
        raise DamagedRun(path, "a line is no JSON object")
    return values


#: the learner's names -> the curves'
_RENAMED = {"actor_loss": "policy_loss", "critic_loss": "value_loss"}
_KEPT = ("entropy", "explained_variance", "kl", "clip_fraction", "action_std", "learning_rate")


def iteration_metrics(
    rollout: Rollout, rewards: NDArray[np.floating], losses: dict[str, float], horizon_steps: int
) -> dict[str, float]:
    """The points that one iteration adds to the curves.

    Args:
        rewards: (L, E) or (L, E, N), those the policy learned from.
        losses: what `Learner.update` gave.

    Returns:
        `true_return` if an episode ended, `learned_return` (the mean reward, times an episode's steps: it can be told
        for every rollout), `true_reward_correlation` over the rollout's steps where it is defined, and the losses.
    """
    shared = rewards.mean(axis=2) if rewards.ndim == 3 else rewards
    values = {_RENAMED.get(name, name): value for name, value in losses.items() if name in _RENAMED or name in _KEPT}
    values["learned_return"] = float(shared.mean()) * horizon_steps
    if len(rollout.episode_returns):
        values["true_return"] = float(rollout.episode_returns.mean())
    agreement = correlation(shared.ravel(), rollout.rewards.ravel())
    if math.isfinite(agreement):
        values["true_reward_correlation"] = agreement
    return values


#: names of event files, which TensorBoard looks for
EVENTS = "events.out.tfevents.*"
#: seconds after which a point is on disk at the latest
_FLUSH_SECONDS = 10
#: where a curve is found on the page, by what its name begins with; all others are the learner's
_GROUPS = {
    "true_return": "return",
    "learned_return": "return",
    "evaluation": "evaluation",
    "true_reward_correlation": "reward",
    "reward_version": "reward",
    "seconds": "speed",
    "steps_per_second": "speed",
}
#: what every point has: no curves of their own
_COORDINATES = ("iteration", "steps", "time")


class EventFile:
    """Writes each number of each line as a scalar, by environment steps.

    Args:
        folder: of the run, whose name TensorBoard shows; what a process before this one wrote is replaced by `lines`,
            so that no point is missing or there twice.
        lines: so far.
    """

    def __init__(self, folder: Path, lines: Iterable[Metrics]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob(EVENTS):
            old.unlink()
        self._writer = SummaryWriter(str(folder), flush_secs=_FLUSH_SECONDS)
        for line in lines:
            self.append(line)

    def append(self, values: Metrics) -> None:
        """Add the points of an iteration."""
        for name, value in values.items():
            if name not in _COORDINATES and not isinstance(value, str):
                self._writer.add_scalar(tag(name), value, int(values["steps"]), float(values["time"]))

    def close(self) -> None:
        self._writer.close()


def tag(name: str) -> str:
    """`group/name`, under which TensorBoard shows the curve of this name."""
    return f"{next((group for prefix, group in _GROUPS.items() if name.startswith(prefix)), 'learner')}/{name}"
