"""True return of whole episodes, given up when the process is to stop."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mapt.policies import Learner, evaluate
from mapt.tasks import Task, TaskStep, WrappedTask, make_task

#: episodes of an evaluation: the mean's standard error is a sixth of their spread
EVALUATION_EPISODES = 32
#: keeps the evaluation's starts apart from those of training
_EVALUATION_SEED = 1_000_003


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
    task = InterruptibleTask(make_task(task_name, EVALUATION_EPISODES, n_threads=learner.config.n_threads), stopped)
    try:
        returns = evaluate(learner, task, EVALUATION_EPISODES, seed=seed + _EVALUATION_SEED)
    finally:
        task.close()
    return {
        name: float(returns.mean()),
        f"{name}_std": float(returns.std()),
        f"{name}_min": float(returns.min()),
        f"{name}_max": float(returns.max()),
    }
