"""The policy of one experiment in memory: made anew or restored, and stored again."""

from dataclasses import dataclass

from accord.domain.experiment import ExperimentConfig
from accord.services import checkpoints
from accord.services.policy_settings import policy_settings
from accord.store.blobs import BlobStore
from accord.store.database import Database
from accord.workers.policy_blobs import read_checkpoint, store_checkpoint
from accord.workers.pulse import Claim
from accord.workers.reward_source import RewardSource, make_reward_source
from mapt.policies import Learner
from mapt.runs.checkpoint import PolicyCheckpoint
from mapt.tasks import make_task


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
        InvalidExperiment: if `config.policy` makes no sense; one that was made by another version may.
        mapt.policies.InvalidConfig: if its device is not here.
        BlobMissing, mapt.policies.InvalidCheckpoint: if the checkpoint is gone, or damaged.
    """
    settings = policy_settings(config, n_threads)
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
