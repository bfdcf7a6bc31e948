"""One experiment's policy, from claim to release: collect, store segments, wait for labels, relabel, update.

Between two iterations the worker reads the rows again (paused, cancelled, a newer reward version, missing labels) and
decides the next step from them. A process may be killed anywhere: its successor resumes from the last checkpoint.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from accord.domain.enums import ExperimentStatus, Phase
from accord.domain.errors import InvalidExperiment
from accord.services import checkpoints, collect, experiments, metrics, publish, select
from accord.services.collect import NewSegment
from accord.services.experiment_config import ExperimentConfig
from accord.store.blobs import BlobStore
from accord.store.database import Database
from accord.store.tables import ExperimentRow, RewardVersionRow
from accord.workers.heartbeat import Claim
from accord.workers.model_store import read_checkpoint, store_checkpoint
from accord.workers.pacing import Progress, cannot_begin, segments_to_hand_in, waits_for
from accord.workers.replayed_clips import Redrawing, draws_itself
from accord.workers.reward_source import RewardSource, make_reward_source
from accord.workers.runner import Context
from mapt.policies import Learner, Rollout, evaluate
from mapt.preferences.segments import StepRange, cut_rollout
from mapt.tasks import Task, TaskStep, WrappedTask, make_task
from mapt.training.evaluation import EPISODES, SEED_OF_STARTS
from mapt.training.metrics import iteration_metrics
from mapt.training.run_folder import PolicyCheckpoint


def read_progress(
    session: Session, row: ExperimentRow, config: ExperimentConfig, version: RewardVersionRow | None, steps: int
) -> Progress:
    """
    Args:
        config: the experiment's settings, which its row holds as JSON.
        version: the newest one.
        steps: environment steps trained, which the row may not say yet.
    """
    progress = Progress(steps, row.label_count, version.label_count if version else None)
    # Pairs are counted only where labels are missing: it takes longer than the rest.
    waits = waits_for(config, progress) is not None
    return replace(progress, exhausted=waits and select.exhausted(session, row))


class Interrupted(Exception):
    """An evaluation was given up, since the process is to stop."""


class InterruptibleTask(WrappedTask):
    """A task whose next step raises once a stop is wished for: whole episodes take seconds."""

    def __init__(self, task: Task, stopped: Callable[[], bool]) -> None:
        super().__init__(task)
        self._stopped = stopped

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        """Raises Interrupted."""
        if self._stopped():
            raise Interrupted
        return super().step(actions)


def evaluation(learner: Learner, task_name: str, seed: int, name: str, stopped: Callable[[], bool]) -> dict[str, float]:
    """True return of whole episodes with mean actions: `name` and its standard deviation, minimum and maximum.

    Raises:
        Interrupted: if `stopped` said so meanwhile.
    """
    task = InterruptibleTask(make_task(task_name, EPISODES, n_threads=learner.config.n_threads), stopped)
    try:
        returns = evaluate(learner, task, EPISODES, seed=seed + SEED_OF_STARTS)
    finally:
        task.close()
    return {
        name: float(returns.mean()),
        f"{name}_std": float(returns.std()),
        f"{name}_min": float(returns.min()),
        f"{name}_max": float(returns.max()),
    }


@dataclass(slots=True)
class Training:
    """A learner between two iterations."""

    learner: Learner
    source: RewardSource
    #: iterations done
    iteration: int
    #: environment steps the learner was updated on
    steps: int


def start_or_restore(
    database: Database, blobs: BlobStore, experiment_id: str, config: ExperimentConfig, n_threads: int
) -> Training:
    """The experiment's training as its newest checkpoint has it; at the beginning where there is none.

    Raises:
        InvalidConfig: if the device is not available, or another version of Accord stored settings that are not valid
            in this one.
        BlobMissing, CheckpointError: if the checkpoint is gone, or damaged.
    """
    settings = config.policy_config(n_threads)
    task = make_task(config.task, settings.n_envs, n_threads=n_threads)
    with database.reading() as session:
        row = checkpoints.newest(session, experiment_id)
    if row is None:
        learner = Learner(task, settings)
        return Training(learner, make_reward_source(blobs, config, settings.n_envs, None, {}), 0, 0)
    stored = read_checkpoint(blobs, row.blob_key)
    learner = Learner.from_bytes(stored.learner, task)
    source = make_reward_source(blobs, config, settings.n_envs, row.reward_version_id, stored.context)
    return Training(learner, source, row.iteration, row.steps)


def save(database: Database, blobs: BlobStore, experiment_id: str, training: Training, claim: Claim) -> None:
    """Write a checkpoint, then its row; forget the oldest ones.

    Call it between iterations: a rollout that was collected and not learned from is not part of a checkpoint.

    Raises:
        ClaimLost: if another worker trains this experiment by now. Nothing of it was changed.
    """
    checkpoint = PolicyCheckpoint(training.learner.to_bytes(), training.source.context())
    key = store_checkpoint(blobs, experiment_id, training.steps, checkpoint)
    with database.transaction() as session:
        claim.check_within(session)
        checkpoints.save(session, experiment_id, training.steps, training.iteration, key, training.source.version_id)
        forgotten = checkpoints.prune(session, experiment_id)
    for old in forgotten:
        blobs.delete(old)


log = logging.getLogger(__name__)

#: checkpoints are this far apart at most, in time
CHECKPOINT_SECONDS = 30.0
#: and in iterations
CHECKPOINT_ITERATIONS = 20
#: which draws of an experiment's seed choose the segments
_SEGMENT_STREAM = 7
#: curves of one point: the policy before it learned anything, and at the end
UNTRAINED, FINAL = "true_return_untrained", "true_return_final"


@dataclass(frozen=True, slots=True)
class _Seen:
    """The rows that decide the next step, read in one transaction."""

    status: str
    progress: Progress
    version: RewardVersionRow | None


class PolicyRun:
    """Trains one experiment under a claim."""

    def __init__(self, context: Context, experiment_id: str, config: ExperimentConfig, claim: Claim) -> None:
        self._context = context
        self._id = experiment_id
        self._config = config
        self._claim = claim
        self._training: Training = start_or_restore(
            context.database, context.blobs, experiment_id, config, context.settings.torch_threads
        )
        asks = config.reward_source == "preferences" and config.render_clips
        #: whether clips can be drawn by the task alone, and so by this worker
        self._draws = asks and draws_itself(self._training.learner.task)
        #: collected and not learned from yet
        self._rollout: Rollout | None = None
        self._collect_seconds = 0.0
        self._saved_at = time.monotonic()
        self._saved_iteration = self._training.iteration
        #: what the experiment's row says by now, as far as this worker knows
        self._said: tuple[Phase, str, int] | None = None

    def step(self) -> bool:
        """Whatever comes next. Returns False when there is nothing to do but wait.

        Raises:
            InvalidExperiment: if there are too few segments for the first labels.
            ClaimLost: if another worker took the experiment over.
            Interrupted: if the process was asked to stop in the middle of an evaluation.
        """
        self._claim.check()
        seen = self._look()
        if seen.status != ExperimentStatus.RUNNING:
            return False
        training = self._training
        if training.steps >= self._config.total_steps:
            self._finish()
            return True
        waiting = waits_for(self._config, seen.progress)
        untouched = training.iteration == 0 and self._rollout is None
        if waiting and not untouched:
            if hopeless := cannot_begin(self._config, seen.progress):
                raise InvalidExperiment(hopeless)
            self._wait(waiting)
            return False
        rollout = self._rollout or self._collect()
        # Only the very first rollout is kept while it waits: its segments are what the first labels are about.
        if not waiting:
            self._update(rollout, seen)
        return True

    @property
    def over(self) -> bool:
        """Whether the experiment is running no more."""
        return self._look().status != ExperimentStatus.RUNNING

    def leave(self) -> None:
        """Keep what was learned since the last checkpoint, before the claim is released."""
        # A rollout in hand is not lost: from the checkpoint before it, the same one is collected again.
        if self._training.iteration > self._saved_iteration and self._rollout is None and not self._claim.lost:
            self._save()

    def close(self) -> None:
        self._training.learner.task.close()

    def _look(self) -> _Seen:
        with self._context.database.reading() as session:
            row = experiments.get(session, self._id)
            version = publish.newest(session, self._id)
            progress = read_progress(session, row, self._config, version, self._training.steps)
            return _Seen(row.status, progress, version)

    def _collect(self) -> Rollout:
        training = self._training
        self._say(Phase.COLLECTING if training.iteration == 0 else Phase.TRAINING)
        started = time.monotonic()
        before = training.learner.task.snapshot() if self._draws else None
        rollout = self._rollout = training.learner.collect()
        self._collect_seconds = time.monotonic() - started
        self._hand_in(rollout, before)
        return rollout

    def _hand_in(self, rollout: Rollout, before: dict[str, np.ndarray] | None) -> None:
        """Give some segments of the rollout to the pool that queries are made from.

        Args:
            before: snapshot of the task before the rollout, where it must draw itself.
        """
        training, config = self._training, self._config
        with self._context.database.reading() as session:
            newest = select.candidates(session, self._id, limit=1)
        if newest and newest[0][1] >= training.steps:
            return  # handed in by a process that was killed after, before a checkpoint
        rng = np.random.default_rng([config.seed, _SEGMENT_STREAM, training.iteration])
        places = cut_rollout(rollout.episode_start, rollout.terminated, config.segment_steps, rng)
        wanted = segments_to_hand_in(
            config,
            iteration=training.iteration,
            rollout_steps=training.learner.config.steps_per_rollout,
            fitting=len(places),
        )
        if wanted == 0:
            return
        stored = [
            collect.store_arrays(self._context.blobs, self._id, self._segment(rollout, place))
            for place in places[:wanted]
        ]
        if before is not None:
            redrawing = Redrawing(training.learner.task, before, rollout)
            keys = [segment.blob_key for segment in stored]
            redrawing.store(self._context.blobs, places[:wanted], keys)
        with self._context.database.transaction() as session:
            self._claim.check_within(session)
            collect.collect(session, self._id, stored)

    def _segment(self, rollout: Rollout, place: StepRange) -> NewSegment:
        at = slice(place.first, place.end), place.env
        return NewSegment(
            observations=rollout.observations[at],
            actions=rollout.actions[at],
            rewards=rollout.rewards[at],
            qpos=rollout.qpos[at],
            qvel=rollout.qvel[at],
            policy_iteration=self._training.iteration,
            policy_steps=self._training.steps,
        )

    def _wait(self, why: str) -> None:
        self.leave()
        self._context.pulse.say("working", f"waits: {why}")
        self._say(Phase.WAITING_FOR_LABELS, why)

    def _update(self, rollout: Rollout, seen: _Seen) -> None:
        """Relabel the whole rollout by one version, learn from it, write down what came of it."""
        training, source = self._training, self._training.source
        if training.iteration == 0 and not self._has_measured(UNTRAINED):
            # Not before: until the first version is there, the processors are for the first clips.
            self._measure(UNTRAINED)
        started = time.monotonic()
        if seen.version is not None and source.adopt(seen.version):
            training.learner.reward_changed()
        rewards = source.rewards(rollout)
        losses = training.learner.update(rollout, rewards)
        seconds = self._collect_seconds + time.monotonic() - started
        self._rollout = None
        training.iteration += 1
        training.steps += training.learner.config.steps_per_rollout
        values = iteration_metrics(rollout, rewards, losses, training.learner.task.spec.horizon_steps)
        values["steps_per_second"] = training.learner.config.steps_per_rollout / seconds
        if self._config.reward_source == "preferences":
            values |= {"labels": seen.progress.labels, "reward_version": seen.version.number if seen.version else 0}
        self._record(values)
        self._save_now_and_then()

    def _record(self, values: dict[str, float]) -> None:
        training = self._training
        with self._context.database.transaction() as session:
            self._claim.check_within(session)
            metrics.record(session, self._id, training.steps, values, training.source.version_id)
            experiments.report(session, self._id, phase=Phase.TRAINING, steps=training.steps)
        self._said = Phase.TRAINING, "", training.steps
        share = min(1.0, training.steps / self._config.total_steps)
        self._context.pulse.say("working", f"{self._config.task}, {share:.0%} of its steps")

    def _say(self, phase: Phase, detail: str = "") -> None:
        if (phase, detail, self._training.steps) == self._said:
            return
        with self._context.database.transaction() as session:
            self._claim.check_within(session)
            experiments.report(session, self._id, phase=phase, detail=detail, steps=self._training.steps)
        self._said = phase, detail, self._training.steps

    def _save_now_and_then(self) -> None:
        due = time.monotonic() - self._saved_at > CHECKPOINT_SECONDS
        if due or self._training.iteration - self._saved_iteration >= CHECKPOINT_ITERATIONS:
            self._save()

    def _save(self) -> None:
        save(self._context.database, self._context.blobs, self._id, self._training, self._claim)
        self._saved_at, self._saved_iteration = time.monotonic(), self._training.iteration

    def _has_measured(self, name: str) -> bool:
        with self._context.database.reading() as session:
            return bool(metrics.series(session, self._id, [name]))

    def _measure(self, name: str) -> None:
        """Play whole episodes with the policy as it is, and record their true return."""
        self._say(Phase.EVALUATING, f"{EPISODES} episodes.")
        values = evaluation(
            self._training.learner, self._config.task, self._config.seed, name, lambda: self._context.stop.requested
        )
        with self._context.database.transaction() as session:
            self._claim.check_within(session)
            metrics.record(session, self._id, self._training.steps, values, self._training.source.version_id)

    def _finish(self) -> None:
        self.leave()
        self._measure(FINAL)
        with self._context.database.transaction() as session:
            self._claim.check_within(session)
            experiments.finish(session, self._id)
