"""MAPT: preference-based reward learning for cooperative multi-agent reinforcement learning.

The functions below go from a task to a policy that is trained on preferences; docs/library.md shows them. The parts
that they are made of are in the subpackages `tasks`, `preferences`, `rewards`, `policies`, `imitation`, `training`,
`benchmarks` and `rendering`. Every exception derives from `mapt.errors.MaptError`.

Importing `mapt` imports none of them: a name is imported when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

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


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("mapt.tasks" if name in _OF_TASKS else "mapt.api"), name)


def __dir__() -> list[str]:
    return sorted((*globals(), *__all__))
