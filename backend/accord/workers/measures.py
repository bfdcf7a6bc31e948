"""What is written down of an iteration, under the names that curves have everywhere."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mapt.policies import Learner, Rollout, evaluate
from mapt.tasks import MaskingTask, Task, TaskSpec, TaskStep, make_task

#: episodes of an evaluation: the mean's standard error is a sixth of their spread
EVALUATION_EPISODES = 32
#: the learner's names -> the curves'
_RENAMED = {"actor_loss": "policy_loss", "critic_loss": "value_loss"}
_KEPT = ("entropy", "explained_variance", "kl", "clip_fraction", "action_std", "learning_rate")
#: keeps the evaluation's starts apart from those of training
_EVALUATION_SEED = 1_000_003


def iteration_metrics(
    rollout: Rollout, rewards: NDArray[np.floating], losses: dict[str, float], horizon_steps: int
) -> dict[str, float]:
    """The points that one iteration adds to the curves.

    Args:
        rewards: (L, E) or (L, E, N), those the policy learned from.
        losses: what `Learner.update` gave.

    Returns:
        `true_return` if an episode ended, `learned_return` (the mean reward, times an episode's steps: it can be told
        for every rollout), `true_reward_correlation` over the rollout's steps where it is defined, and the losses.
    """
    shared = rewards.mean(axis=2) if rewards.ndim == 3 else rewards
    values = {_RENAMED.get(name, name): value for name, value in losses.items() if name in _RENAMED or name in _KEPT}
    values["learned_return"] = float(shared.mean()) * horizon_steps
    if len(rollout.episode_returns):
        values["true_return"] = float(rollout.episode_returns.mean())
    if (agreement := _correlation(shared, rollout.rewards)) is not None:
        values["true_reward_correlation"] = agreement
    return values


def _correlation(first: NDArray[np.floating], second: NDArray[np.floating]) -> float | None:
    left, right = (values.astype(np.float64).ravel() - values.mean() for values in (first, second))
    scale = math.sqrt(float((left**2).sum()) * float((right**2).sum()))
    return float((left * right).sum()) / scale if scale > 0 else None


class Interrupted(Exception):
    """An evaluation was given up, since the process is to stop."""


class InterruptibleTask:
    """A task whose next step raises once a stop is wished for: whole episodes take seconds."""

    def __init__(self, task: Task, stopped: Callable[[], bool]) -> None:
        self._task = task
        self._stopped = stopped
        self.n_envs = task.n_envs

    @property
    def spec(self) -> TaskSpec:
        return self._task.spec

    def reset(self, seed: int) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        return self._task.reset(seed)

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        """Raises Interrupted."""
        if self._stopped():
            raise Interrupted
        return self._task.step(actions)

    def simulator_state(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self._task.simulator_state()

    def available_actions(self) -> NDArray[np.bool_] | None:
        return self._task.available_actions() if isinstance(self._task, MaskingTask) else None

    def snapshot(self) -> dict[str, np.ndarray]:
        return self._task.snapshot()

    def restore(self, snapshot: dict[str, np.ndarray]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        return self._task.restore(snapshot)

    def close(self) -> None:
        self._task.close()


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
