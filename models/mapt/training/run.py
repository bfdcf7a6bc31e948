"""One run: train, evaluate, record a video. Called again, it resumes from the last checkpoint."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mapt.errors import RenderingError
from mapt.io import atomic_write
from mapt.policies import Learner
from mapt.processes import Desk, stop_requests
from mapt.tasks import Task, TaskStep, WrappedTask, make_task
from mapt.training.evaluation import Evaluation, evaluate_policy
from mapt.training.metrics import EventFile, Metrics, MetricsFile, iteration_metrics, read_metrics
from mapt.training.reward_source import RewardSource, make_reward_source
from mapt.training.run_folder import PolicyCheckpoint, RunFolder
from mapt.training.settings import RunSettings
from mapt.training.video import record_video


class TimedTask(WrappedTask):
    """Adds up the seconds that its steps take: physics, and what a task makes of them."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self._seconds = 0.0

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        started = time.perf_counter()
        try:
            return super().step(actions)
        finally:
            self._seconds += time.perf_counter() - started

    def take_seconds(self) -> float:
        """The seconds since the last call."""
        seconds, self._seconds = self._seconds, 0.0
        return seconds


@dataclass(frozen=True, slots=True)
class Watch:
    """Whoever looks on while a run is trained."""

    #: after each iteration, with what was written down of it
    on_iteration: Callable[[Metrics], None] = lambda metrics: None
    #: told in a sentence what the metrics do not show
    note: Callable[[str], None] = lambda sentence: None
    #: asked after each iteration; true ends the training, to be gone on with
    stopped: Callable[[], bool] = lambda: False


class Run:
    """A learner, its rewards and its files, between two iterations. Hold `folder.locked()` meanwhile.

    Args:
        settings: as the folder's run has them, or of a new run.
        folder: where the run is, or will be.
        checkpoint_seconds: between two checkpoints at least.
        physics_threads: as `n_threads` of `make_task`; nothing that is learned depends on it.

    Raises:
        RunMismatch, DamagedRun: if the folder holds another run, or one that cannot be read.
        UnknownTask, InvalidConfig, CheckpointError, ModelMismatch: if the settings cannot be met.
    """

    def __init__(
        self,
        settings: RunSettings,
        folder: RunFolder,
        checkpoint_seconds: float,
        watch: Watch,
        *,
        physics_threads: int = 0,
    ) -> None:
        self._settings, self._folder, self._watch = settings, folder, watch
        self._checkpoint_seconds, self._physics_threads = checkpoint_seconds, physics_threads
        folder.check(settings)
        self._task = TimedTask(
            make_task(settings.task, settings.policy.n_envs, n_threads=physics_threads, agent_obsk=settings.agent_obsk)
        )
        try:
            self.learner, self._source, self.iteration = self._start_or_restore()
        except BaseException:
            self._task.close()
            raise
        folder.claim(settings)
        self._metrics = MetricsFile(folder.metrics, self.iteration)
        self._events = EventFile(folder.path, read_metrics(folder.metrics))
        self._saved_at, self._saved_iteration = time.monotonic(), self.iteration

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._events.close()
        self._metrics.close()
        self._task.close()

    def train(self) -> bool:
        """Iterate until the steps are done, or a stop is asked for; the checkpoint is then of the last iteration.

        Returns:
            Whether the steps are done.
        """
        while self.learner.steps < self._settings.steps and not self._watch.stopped():
            metrics = self._iterate()
            self._metrics.append(metrics)
            self._events.append(metrics)
            self._watch.on_iteration(metrics)
            if time.monotonic() - self._saved_at >= self._checkpoint_seconds:
                self._save()
        if self.iteration > self._saved_iteration:
            self._save()
        return self.learner.steps >= self._settings.steps

    def _start_or_restore(self) -> tuple[Learner, RewardSource, int]:
        settings, folder = self._settings, self._folder
        stored = folder.last_checkpoint()
        if stored is None:
            stored, learner = PolicyCheckpoint(b"", {}), Learner(self._task, settings.policy)
        else:
            learner = Learner.from_bytes(stored.learner, self._task)
        source = make_reward_source(
            settings,
            self._task.spec,
            stored.progress,
            stored.context,
            keep=folder.rewards,
            note=self._watch.note,
        )
        iteration = stored.progress.get("iteration", 0)
        return learner, source, iteration if isinstance(iteration, int) else 0

    def _iterate(self) -> Metrics:
        """Collect a rollout, reward it by one version, learn from it. Returns the line that tells of it."""
        learner, clock = self.learner, Clock()
        self._task.take_seconds()
        rollout = learner.collect()
        physics = self._task.take_seconds()
        collecting = clock.lap()
        if self._source.refresh():
            learner.reward_changed()
        rewards = self._source.rewards(rollout)
        rewarding = clock.lap()
        losses = learner.update(rollout, rewards)
        updating = clock.lap()
        self.iteration += 1
        return {
            "iteration": self.iteration,
            "steps": learner.steps,
            **iteration_metrics(rollout, rewards, losses, self._task.spec.horizon_steps),
            **self._source.metrics(),
            **self._evaluate_now_and_then(),
            "time": time.time(),
            "steps_per_second": learner.config.steps_per_rollout / (collecting + rewarding + updating),
            "seconds_physics": physics,
            "seconds_inference": collecting - physics,
            "seconds_reward": rewarding,
            "seconds_update": updating,
        }

    def _evaluate_now_and_then(self) -> dict[str, float]:
        every, done = self._settings.evaluate_every_steps, self.learner.steps
        if not every or done // every == (done - self.learner.config.steps_per_rollout) // every:
            return {}
        return {f"evaluation_{name}": value for name, value in self.evaluate().summary().items()}

    def evaluate(self) -> Evaluation:
        """Episodes of the policy as it is; nothing that is learned from is touched."""
        settings = self._settings
        seed = settings.policy.seed
        return evaluate_policy(
            self.learner.policy,
            settings.task,
            agent_obsk=settings.agent_obsk,
            seed=seed,
            n_threads=self._physics_threads,
        )

    def _save(self) -> None:
        progress = {"iteration": self.iteration, **self._source.progress}
        # Lines first: a checkpoint vouches for those before it.
        self._metrics.sync()
        stored = PolicyCheckpoint(self.learner.to_bytes(), self._source.context(), progress)
        atomic_write(self._folder.checkpoint, stored.to_bytes())
        self._saved_at, self._saved_iteration = time.monotonic(), self.iteration


class Clock:
    """Seconds from one call to the next."""

    def __init__(self) -> None:
        self._since = time.perf_counter()

    def lap(self) -> float:
        now = time.perf_counter()
        seconds, self._since = now - self._since, now
        return seconds


def complete_run(
    settings: RunSettings,
    folder: RunFolder,
    checkpoint_seconds: float,
    watch: Watch,
    *,
    video: bool = True,
    physics_threads: int = 0,
) -> Evaluation | None:
    """Train, evaluate and film; whatever of it is done already is not done again.

    A video that cannot be made is told to `watch`, and missing.

    Returns:
        What the final policy did; None if `watch` stopped the training before its steps were done.

    Raises:
        RunBusy: if another process trains in this folder.
        See `Run` for what else.
    """
    with (
        folder.locked(),
        Run(settings, folder, checkpoint_seconds, watch, physics_threads=physics_threads) as run,
    ):
        if not run.train():
            return None
        evaluation = folder.read_evaluation(run.learner.steps)
        if evaluation is None:
            folder.video.unlink(missing_ok=True)
            evaluation = run.evaluate()
            folder.write_evaluation(run.learner.steps, evaluation)
        if video and not folder.video.exists():
            _film(run, settings, folder, watch)
        return evaluation


def _film(run: Run, settings: RunSettings, folder: RunFolder, watch: Watch) -> None:
    seed = settings.policy.seed
    try:
        record_video(run.learner.policy, settings.task, folder.video, agent_obsk=settings.agent_obsk, seed=seed)
    except RenderingError as error:
        watch.note(f"No video: {error}")


#: what is told of a run on its way: what was written down of an iteration, or a sentence
News = Metrics | str


@dataclass(frozen=True, slots=True)
class RunJob:
    """A run to be made."""

    settings: RunSettings
    folder: Path
    #: between two checkpoints at least
    checkpoint_seconds: float
    #: film the final policy
    video: bool
    #: as `n_threads` of `make_task`
    physics_threads: int


def make_run(job: RunJob, told: Callable[[News], None], stopped: Callable[[], bool]) -> Evaluation | None:
    """What `complete_run` gives and raises."""
    return complete_run(
        job.settings,
        RunFolder(job.folder),
        job.checkpoint_seconds,
        Watch(on_iteration=told, note=told, stopped=stopped),
        video=job.video,
        physics_threads=job.physics_threads,
    )


def make_run_apart(job: RunJob, desk: Desk) -> Evaluation | None:
    """`make_run` by a worker of `run_jobs`, which Ctrl-C and SIGTERM reach as well as its parent."""
    with stop_requests() as asked:
        return make_run(job, desk.tell, lambda: asked() or desk.unwanted())
