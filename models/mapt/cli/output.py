"""What the commands print: plain lines where the output is no terminal."""

import sys
from collections.abc import Hashable
from dataclasses import dataclass
from datetime import datetime
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mapt.training.evaluation import Evaluation
from mapt.training.metrics import Metrics
from mapt.training.run import RunJob, RunReport

#: what was asked for
out = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 100)
#: what went wrong
err = Console(stderr=True, highlight=False, soft_wrap=True)


def say(text: str) -> None:
    """A line of rich markup."""
    out.print(text)


def note(text: str) -> None:
    """A line of a long run: the time, and what. No markup."""
    now = datetime.now().astimezone().strftime("%H:%M:%S")
    out.print(f"[dim]{now}[/dim] {escape(text)}")


def complain(text: str) -> None:
    """An error: one sentence."""
    err.print(f"[bold red]mapt:[/bold red] {escape(text)}")


def on_terminal() -> bool:
    return sys.stdout.isatty()


class Bars:
    """A bar for each of several works, as they begin.

    Args:
        noted_share: without a terminal, a line each time so much more of a work is done.
    """

    def __init__(self, noted_share: float) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"))
        self._progress = Progress(
            *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=out, disable=not on_terminal()
        )
        self._noted_share = noted_share
        self._bars: dict[Hashable, _Bar] = {}

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def begin(self, work: Hashable, name: str, total: float) -> None:
        self._bars[work] = _Bar(name, total, self._progress.add_task(name, total=total, state=""))

    def show(self, work: Hashable, done: float, state: str) -> None:
        """Say how much of a work is done, and in a few words what that is like."""
        bar = self._bars[work]
        share = min(1.0, done / bar.total)
        self._progress.update(bar.drawn, completed=share * bar.total, state=state)
        if not on_terminal() and share >= bar.noted + self._noted_share:
            bar.noted = share
            note(f"{bar.name}: {share:.0%}, {state}")

    def end(self, work: Hashable) -> None:
        self._progress.stop_task(self._bars[work].drawn)


@dataclass(slots=True)
class _Bar:
    name: str
    total: float
    drawn: TaskID
    #: share of the work that was last told of in a line
    noted: float = 0.0


class RunBars:
    """One bar for each run that was begun."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        #: how a run's newest episodes ended, in words
        self._returns: dict[RunJob, str] = {}

    def begin(self, job: RunJob) -> None:
        self._bars.begin(job, _name(job), job.settings.steps)

    def tell(self, job: RunJob, news: RunReport) -> None:
        if isinstance(news, str):
            note(f"{_name(job)}: {news}")
        else:
            self._bars.show(job, float(news["steps"]), self._state(job, news))

    def end(self, job: RunJob, evaluation: Evaluation | None) -> None:
        """Say what the run's final policy did, if it came to that."""
        self._bars.end(job)
        if evaluation is not None:
            note(f"seed {job.settings.policy.seed}: {sentence(evaluation)}; {job.folder}")

    def _state(self, job: RunJob, metrics: Metrics) -> str:
        # In most iterations no episode ends.
        if "true_return" in metrics:
            self._returns[job] = f"true return {float(metrics['true_return']):,.0f}, "
        return f"{self._returns.get(job, '')}{float(metrics['steps_per_second']):,.0f} steps/s"


def sentence(evaluation: Evaluation) -> str:
    """What the episodes of an evaluation were like."""
    found = evaluation.summary()
    return (
        f"true return {found['mean']:,.1f} ± {found['std']:,.1f} (interquartile mean {found['iqm']:,.1f}) "
        f"over {len(evaluation.returns)} episodes of {found['length']:,.0f} steps"
    )


def _name(job: RunJob) -> str:
    settings = job.settings
    return f"{settings.task}, {settings.policy.algorithm}, seed {settings.policy.seed}"
