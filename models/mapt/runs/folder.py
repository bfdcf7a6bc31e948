"""Where the files of a run lie, and who may write them."""

import fcntl
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from mapt.policies.checkpoint import write_whole
from mapt.runs.checkpoint import PolicyCheckpoint
from mapt.runs.errors import DamagedRun, OtherRun, RunBusy
from mapt.runs.evaluation import Evaluation
from mapt.runs.settings import RunSettings

FORMAT_VERSION = 1
RUN_FILE = "run.json"
CHECKPOINT_FILE = "checkpoint.safetensors"
METRICS_FILE = "metrics.jsonl"
EVALUATION_FILE = "evaluation.json"
VIDEO_FILE = "final.mp4"
REWARDS_FOLDER = "rewards"


class RunFolder:
    """One run's files."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoint = path / CHECKPOINT_FILE
        self.metrics = path / METRICS_FILE
        self.evaluation = path / EVALUATION_FILE
        self.video = path / VIDEO_FILE
        self.rewards = path / REWARDS_FOLDER

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Be the only process that trains here; the lock goes with the process, however that ends.

        Raises:
            RunBusy: if another one does.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        with (self.path / "lock").open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise RunBusy(self.path) from error
            yield

    def check(self, settings: RunSettings) -> None:
        """Make sure that a run that is here has these settings.

        Raises:
            OtherRun: if it has others.
            DamagedRun: if its settings cannot be read.
        """
        if (self.path / RUN_FILE).exists() and (differences := self.settings().differences(settings)):
            raise OtherRun(self.path, differences)

    def claim(self, settings: RunSettings) -> None:
        """Write the settings of a new run, or of one that is made longer; raises as `check` does."""
        self.check(settings)
        if (self.path / RUN_FILE).exists():
            settings = replace(settings, steps=max(settings.steps, self.settings().steps))
        card = {"format_version": FORMAT_VERSION, **settings.to_dict()}
        write_whole(self.path / RUN_FILE, json.dumps(card, indent=2).encode() + b"\n")

    def settings(self) -> RunSettings:
        """What the run was started with.

        Raises:
            DamagedRun: if that cannot be read.
        """
        path = self.path / RUN_FILE
        try:
            card = json.loads(path.read_bytes())
            version = card.pop("format_version")
            if version != FORMAT_VERSION:
                raise DamagedRun(path, f"its format is {version}, known is {FORMAT_VERSION}")
            return RunSettings.from_dict(card)
        except DamagedRun:
            raise
        except (OSError, ValueError, AttributeError, KeyError) as error:
            raise DamagedRun(path, str(error)) from error

    def last_checkpoint(self) -> PolicyCheckpoint | None:
        """Where the run stands; None if it was killed before its first checkpoint.

        Raises:
            mapt.policies.InvalidCheckpoint: if it is damaged.
        """
        return PolicyCheckpoint.from_bytes(self.checkpoint.read_bytes()) if self.checkpoint.exists() else None

    def read_evaluation(self, steps: int) -> Evaluation | None:
        """What the policy after so many steps did; None if it was not evaluated.

        Raises:
            DamagedRun: if the file is not as it was written.
        """
        if not self.evaluation.exists():
            return None
        try:
            stored = json.loads(self.evaluation.read_bytes())
            return Evaluation.from_dict(stored) if stored["steps"] == steps else None
        except (ValueError, KeyError, TypeError) as error:
            raise DamagedRun(self.evaluation, str(error)) from error

    def write_evaluation(self, steps: int, evaluation: Evaluation) -> None:
        """Keep what the policy after so many steps did."""
        content = json.dumps({"steps": steps, **evaluation.to_dict()}, indent=2)
        write_whole(self.evaluation, content.encode() + b"\n")
