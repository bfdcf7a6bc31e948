"""How long a task's physics take, from outside."""

import time

import numpy as np
from numpy.typing import NDArray

from mapt.tasks import Task, TaskStep, WrappedTask


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
