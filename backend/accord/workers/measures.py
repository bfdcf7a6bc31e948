"""True return of whole episodes, given up when the process is to stop."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mapt.policies import Learner, evaluate
from mapt.runs.evaluation import EPISODES, SEED_OF_STARTS
from mapt.tasks import Task, TaskStep, WrappedTask, make_task


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
