"""How far runs are, and what became of them."""

from mapt.cli.bars import Bars
from mapt.cli.output import note
from mapt.training.evaluation import Evaluation
from mapt.training.metrics import Metrics
from mapt.training.run import News, RunJob


class RunBars:
    """One bar for each run that was begun."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        #: how a run's newest episodes ended, in words
        self._returns: dict[RunJob, str] = {}

    def begin(self, job: RunJob) -> None:
        self._bars.begin(job, _name(job), job.settings.steps)

    def tell(self, job: RunJob, news: News) -> None:
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
