"""A task behind another: what wrappers that change one thing have in common."""

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.protocol import MaskingTask, Task, TaskSpec, TaskStep


class WrappedTask:
    """Does what the task within does; a subclass overrides what it changes. It may stand for a `MaskingTask` too.

    Args:
        task: what is wrapped; closed with this one.
    """

    def __init__(self, task: Task) -> None:
        self._task = task

    @property
    def spec(self) -> TaskSpec:
        return self._task.spec

    @property
    def n_envs(self) -> int:
        return self._task.n_envs

    def reset(self, seed: int) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        return self._task.reset(seed)

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        return self._task.step(actions)

    def simulator_state(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self._task.simulator_state()

    def available_actions(self) -> NDArray[np.bool_] | None:
        """See `MaskingTask`; none if every action always is."""
        return self._task.available_actions() if isinstance(self._task, MaskingTask) else None

    def snapshot(self) -> dict[str, np.ndarray]:
        return self._task.snapshot()

    def restore(self, snapshot: dict[str, np.ndarray]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        return self._task.restore(snapshot)

    def close(self) -> None:
        self._task.close()
