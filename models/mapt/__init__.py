"""MAPT: preference-based reward learning for cooperative multi-agent reinforcement learning.

The functions below go from a task to a policy that is trained on preferences; docs/library.md shows them. The parts
that they are made of are in the subpackages `tasks`, `preferences`, `rewards`, `policies`, `imitation`, `training`,
`benchmarks` and `rendering`. Every exception derives from `mapt.errors.MaptError`.

Importing `mapt` imports none of them: a name is imported when it is first used.
"""

from typing import TYPE_CHECKING

from mapt.lazy import lazy_attributes

if TYPE_CHECKING:
    from mapt.api import (
        Preferences,
        Replay,
        Reward,
        Segments,
        TrainedPolicy,
        collect,
        evaluate,
        label,
        load_policy,
        load_reward,
        train_policy,
        train_reward,
    )
    from mapt.tasks import make_task, register_task, task_names

__all__ = [
    "Preferences",
    "Replay",
    "Reward",
    "Segments",
    "TrainedPolicy",
    "collect",
    "evaluate",
    "label",
    "load_policy",
    "load_reward",
    "make_task",
    "register_task",
    "task_names",
    "train_policy",
    "train_reward",
]

_OF_TASKS = ("make_task", "register_task", "task_names")

__getattr__ = lazy_attributes(__name__, {name: "tasks" if name in _OF_TASKS else "api" for name in __all__})


def __dir__() -> list[str]:
    return sorted((*globals(), *__all__))
