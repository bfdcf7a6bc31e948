"""The curves of a run for TensorBoard. Everything is in metrics.jsonl: these files are made anew from it at will."""

from collections.abc import Iterable
from pathlib import Path

from tensorboardX import SummaryWriter

from mapt.runs.metrics_file import Metrics

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
