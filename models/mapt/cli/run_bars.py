"""How far runs are: bars on a terminal; where there is none, a line now and then."""

from types import TracebackType
from typing import Self

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mapt.cli.output import note, on_terminal, out
from mapt.runs.evaluation import Evaluation
from mapt.runs.metrics_file import Metrics
from mapt.runs.run_job import News, RunJob

#: without a terminal, a line each time so much more of a run is done
_NOTED_SHARE = 0.1


class RunBars:
    """One bar for each run that was begun."""

    def __init__(self) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"))
        self._progress = Progress(
            *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=out, disable=not on_terminal()
        )
        self._bars: dict[RunJob, _Bar] = {}

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._progress.stop()

    def begin(self, job: RunJob) -> None:
        self._bars[job] = _Bar(job, self._progress)

    def tell(self, job: RunJob, news: News) -> None:
        if isinstance(news, str):
            note(f"{_name(job)}: {news}")
        else:
            self._bars[job].show(news)

    def end(self, job: RunJob, evaluation: Evaluation | None) -> None:
        """Say what the run's final policy did, if it came to that."""
        self._bars[job].stop()
        if evaluation is not None:
            note(f"seed {job.settings.policy.seed}: {sentence(evaluation)}; {job.folder}")


class _Bar:
    def __init__(self, job: RunJob, progress: Progress) -> None:
        self._name, self._steps, self._progress = _name(job), job.settings.steps, progress
        self._bar: TaskID = progress.add_task(self._name, total=self._steps, state="")
        self._noted, self._return = 0.0, ""

    def show(self, metrics: Metrics) -> None:
        steps = float(metrics["steps"])
        if "true_return" in metrics:
            self._return = f"true return {float(metrics['true_return']):,.0f}, "
        state = f"{self._return}{float(metrics['steps_per_second']):,.0f} steps/s"
        self._progress.update(self._bar, completed=min(steps, self._steps), state=state)
        share = min(1.0, steps / self._steps)
        if not on_terminal() and share >= self._noted + _NOTED_SHARE:
            self._noted = share
            note(f"{self._name}: {share:.0%}, {state}")

    def stop(self) -> None:
        self._progress.stop_task(self._bar)


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
