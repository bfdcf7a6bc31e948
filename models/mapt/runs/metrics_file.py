"""metrics.jsonl: one line for each iteration, appended as it ends."""

import json
import os
from collections.abc import Mapping
from pathlib import Path

from mapt.runs.errors import DamagedRun

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
