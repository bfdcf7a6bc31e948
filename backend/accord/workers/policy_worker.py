"""The policy worker: `python -m accord.workers.policy_worker`. Trains one experiment at a time."""

import logging
import sys
import time

from accord.domain.enums import WorkerRole
from accord.domain.errors import Invalid
from accord.services import experiments, publish, workers
from accord.services.experiment_config import ExperimentConfig
from accord.workers.heartbeat import Claim, ClaimLost
from accord.workers.pacing import waits_for
from accord.workers.policy_run import Interrupted, PolicyRun, read_progress
from accord.workers.runner import Context, run_worker, sentence
from mapt.errors import ClipNotWritten, InvalidAction, InvalidConfig, TaskError, TrainingDiverged

log = logging.getLogger(__name__)

#: while one experiment waits for labels, the worker looks this often whether another could be trained meanwhile
_LOOK_AROUND_SECONDS = 2.0
#: trying these again would end the same way: the experiment has failed, and says why
_HOPELESS = (Invalid, InvalidAction, InvalidConfig, TaskError, ClipNotWritten, TrainingDiverged)


class PolicyWorker:
    """Claims experiments that run, those first that need not wait for labels."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def work(self) -> bool:
        """Train an experiment until it is over, paused, or waits while another could go on. False if there is none."""
        for experiment_id, config, _ in self._running():
            with self._context.pulse.hold(f"policy:{experiment_id}") as claim:
                if claim is not None:
                    self._train(experiment_id, config, claim)
                    return True
        return False

    def close(self) -> None:
        """Nothing is open between two calls of `work`."""

    def _running(self) -> list[tuple[str, ExperimentConfig, bool]]:
        """(id, settings, whether it waits for labels) of experiments that run: ready ones first, then the oldest."""
        found: list[tuple[str, ExperimentConfig, bool]] = []
        with self._context.database.reading() as session:
            for row in experiments.running(session):
                version = publish.newest(session, row.id)
                config = experiments.config_of(row)
                progress = read_progress(session, row, config, version, row.steps)
                # One that was never begun has its first rollout to collect, whatever it waits for after.
                waits = row.phase != "queued" and waits_for(config, progress) is not None
                found.append((row.id, config, waits))
        return sorted(found, key=lambda each: each[2])

    def _train(self, experiment_id: str, config: ExperimentConfig, claim: Claim) -> None:
        self._context.pulse.say("working", config.task)
        log.info("Experiment %s taken up", experiment_id)
        try:
            run = PolicyRun(self._context, experiment_id, config, claim)
            try:
                self._keep_training(run, experiment_id)
            finally:
                run.close()
        except Interrupted:
            log.info("Experiment %s left in the middle of an evaluation", experiment_id)
        except ClaimLost:
            log.warning("Experiment %s was taken over by another worker", experiment_id)
        except _HOPELESS as error:
            log.exception("Experiment %s failed", experiment_id)
            with self._context.database.transaction() as session:
                claim.check_within(session)
                experiments.fail(session, experiment_id, sentence(error))

    def _keep_training(self, run: PolicyRun, experiment_id: str) -> None:
        looked_at = time.monotonic()
        while not self._context.stop.requested:
            if run.step():
                continue
            if run.over:
                break
            if time.monotonic() - looked_at > _LOOK_AROUND_SECONDS:
                looked_at = time.monotonic()
                if self._another_is_ready(experiment_id):
                    break
            self._context.stop.wait(self._context.settings.poll_seconds)
        run.leave()

    def _another_is_ready(self, experiment_id: str) -> bool:
        ready = [f"policy:{other}" for other, _, waits in self._running() if other != experiment_id and not waits]
        return any(self._is_free(subject) for subject in ready)

    def _is_free(self, subject: str) -> bool:
        with self._context.database.transaction() as session:
            free = workers.claim(session, subject, self._context.holder, self._context.settings.worker_lease_seconds)
            workers.release(session, subject, self._context.holder)
        return free


if __name__ == "__main__":
    sys.exit(run_worker(WorkerRole.POLICY, PolicyWorker, sys.argv[1:]))
