"""Batched multi-agent tasks behind one protocol; numpy and MuJoCo alone."""

from mapt.tasks.entry import MujocoEntry, TaskEntry
from mapt.tasks.errors import (
    InvalidAction,
    InvalidSnapshot,
    InvalidTaskOption,
    NoPicture,
    NoSimulator,
    TaskError,
    TaskExists,
    TaskFileFailed,
    UnknownTask,
    UnusableEnvironment,
)
from mapt.tasks.parallel_entry import ParallelEntry
from mapt.tasks.protocol import DrawnTask, MaskingTask, Task, TaskSpec, TaskStep
from mapt.tasks.registry import agent_geoms, load_model, make_task, register_task, task_names, task_spec
from mapt.tasks.wrapped import WrappedTask

__all__ = [
    "DrawnTask",
    "InvalidAction",
    "InvalidSnapshot",
    "InvalidTaskOption",
    "MaskingTask",
    "MujocoEntry",
    "NoPicture",
    "NoSimulator",
    "ParallelEntry",
    "Task",
    "TaskEntry",
    "TaskError",
    "TaskExists",
    "TaskFileFailed",
    "TaskSpec",
    "TaskStep",
    "UnknownTask",
    "UnusableEnvironment",
    "WrappedTask",
    "agent_geoms",
    "load_model",
    "make_task",
    "register_task",
    "task_names",
    "task_spec",
]
