"""Policy training with any reward function, for tests of learners."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from mapt.policies import Learner, Rollout
from mapt.preferences.teachers import TeacherView
from mapt.training.preference_loop import Segment


def true_reward(rollout: Rollout) -> NDArray[np.floating]:
    """The task's own reward (L, E)."""
    return rollout.rewards


def train(
    learner: Learner,
    reward: Callable[[Rollout], NDArray[np.floating]],
    total_steps: int,
    on_iteration: Callable[[Rollout], bool | None] = lambda rollout: None,
) -> None:
    """Collect, reward and update until the learner has done `total_steps` environment steps, or `on_iteration` ends it.

    Args:
        reward: rewards (L, E) or (L, E, N) of a rollout.
    """
    while learner.steps < total_steps:
        rollout = learner.collect()
        learner.update(rollout, reward(rollout))
        if on_iteration(rollout):
            return


def teacher_view(segments: Sequence[Segment]) -> TeacherView:
    """The arrays of segments that a teacher judges by."""
    return TeacherView.stack(
        [{name: getattr(each, name) for name in ("rewards", "observations", "actions")} for each in segments]
    )
