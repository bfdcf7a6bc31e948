"""Compute the metrics of each iteration, write them to metrics.jsonl and export them to TensorBoard."""

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

#: the metrics of one iteration by name
Metrics = dict[str, float | str]


class MetricsFile:
    """Appends lines to metrics.jsonl, after those of the checkpoint that training resumes from.

    Args:
        path: created if missing.
        lines: lines to keep, one for each iteration before the checkpoint; later ones are deleted.

    Raises:
        DamagedRun: if there are fewer lines.
    """

    def __init__(self, path: Path, lines: int) -> None:
        path.touch()
        self._file = path.open("r+b")
        for _ in range(lines):
            if not self._file.readline().endswith(b"\n"):
                self._file.close()
                raise DamagedRun(path, f"it has fewer than the {lines} lines of the run's checkpoint")
        # A buffered file must seek between reading and writing.
        self._file.seek(self._file.tell())
        self._file.truncate()

    def append(self, values: Mapping[str, float | str]) -> None:
        """Add a line, which other processes can read at once."""
        self._file.write(json.dumps(values).encode() + b"\n")
        self._file.flush()

    def sync(self) -> None:
        """Flush all lines to disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


def read_metrics(path: Path) -> list[Metrics]:
    """The complete lines of a file; the last one may be incomplete while a run trains.

    Raises:
        DamagedRun: if the file is missing, or a complete line is not a JSON object.
    """
    try:
        lines = path.read_bytes().split(b"\n")[:-1]
        values = [json.loads(line) for line in lines]
    except (OSError, ValueError) as error:
        raise DamagedRun(path, str(error)) from error
    if not all(isinstance(line, dict) for line in values):
        raise DamagedRun(path, "a line is not a JSON object")
    return values


#: metrics of `Learner.update` that are recorded under another name
_RENAMED = {"actor_loss": "policy_loss", "critic_loss": "value_loss"}
#: metrics of `Learner.update` that keep their name
_KEPT = ("entropy", "explained_variance", "kl", "clip_fraction", "action_std", "learning_rate")


def iteration_metrics(
    rollout: Rollout, rewards: NDArray[np.floating], losses: dict[str, float], horizon_steps: int
) -> dict[str, float]:
    """The metrics of one iteration.

    Args:
        rewards: (L, E) or (L, E, N), given to `Learner.update`.
        losses: returned by `Learner.update`.

    Returns:
        `true_return` if an episode ended; `learned_return`, the mean reward times the steps of an episode, which is
        defined for every rollout; `true_reward_correlation` over the rollout's steps if defined; and the losses.
    """
    shared = rewards.mean(axis=2) if rewards.ndim == 3 else rewards
    values = {_RENAMED.get(name, name): value for name, value in losses.items() if name in _RENAMED or name in _KEPT}
    values["learned_return"] = float(shared.mean()) * horizon_steps
    if len(rollout.episode_returns):
        values["true_return"] = float(rollout.episode_returns.mean())
    coefficient = correlation(shared.ravel(), rollout.rewards.ravel())
    if math.isfinite(coefficient):
        values["true_reward_correlation"] = coefficient
    return values


#: pattern of TensorBoard's event files
EVENTS = "events.out.tfevents.*"
#: maximum time until a point is on disk
_FLUSH_SECONDS = 10
#: TensorBoard group by prefix of the metric's name; other metrics are in the group `learner`
_GROUPS = {
    "true_return": "return",
    "learned_return": "return",
    "evaluation": "evaluation",
    "true_reward_correlation": "reward",
    "reward_version": "reward",
    "seconds": "speed",
    "steps_per_second": "speed",
}
#: coordinates of every point, which are not plotted
_COORDINATES = ("iteration", "steps", "time")


class EventFile:
    """Writes every number of metrics.jsonl as a TensorBoard scalar, by environment steps.

    Args:
        folder: of the run; TensorBoard shows its name. Existing event files are replaced, so that no point is missing
            or duplicated.
        lines: of metrics.jsonl so far.
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
    """The metric's TensorBoard tag: `group/name`."""
    return f"{next((group for prefix, group in _GROUPS.items() if name.startswith(prefix)), 'learner')}/{name}"
