"""Training of several reward models at the same time, each in a process of its own."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from mapt.errors import MemberTrainingFailed
from mapt.processes import ParentConnection, run_jobs
from mapt.rewards.checkpoints import SavedRewardModel, load_reward_model, save_reward_model
from mapt.rewards.model import RewardModel
from mapt.rewards.stage_trainer import TrainProgress

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class TrainingJob:
    """The training of one of several models: a member of an ensemble, or a network of a version."""

    #: index of the member, or of the fold whose pairs the network holds out
    number: int
    seed: int
    #: the model from which it continues; None for untrained weights
    initial: SavedRewardModel | None

    @classmethod
    def of(cls, number: int, seed: int, initial: RewardModel | None) -> "TrainingJob":
        """A job that can be sent to another process."""
        return cls(number, seed, None if initial is None else save_reward_model(initial, {}))

    def initial_model(self) -> RewardModel | None:
        """The model from which it continues, on the CPU."""
        return None if self.initial is None else load_reward_model(self.initial.weights, self.initial.card).model


def train_in_processes(
    train: Callable[[TrainingJob, ParentConnection], T],
    jobs: Sequence[TrainingJob],
    workers: int,
    *,
    progress: Callable[[TrainProgress], None],
    stop: Callable[[], bool],
) -> dict[int, T]:
    """The results of `train` by the number of their job; jobs that had not started when `stop` became true have none.

    Args:
        train: a partial of a module-level function, which sends each `TrainProgress` to its parent.

    Raises:
        MemberTrainingFailed: if a process ends without a result.
    """
    trained = dict[int, T]()
    for done in run_jobs(train, jobs, workers, on_message=lambda job, at: progress(at), should_stop=stop):
        if done.result is None:
            raise MemberTrainingFailed(done.job.number, done.failure or "")
        trained[done.job.number] = done.result
    return trained
