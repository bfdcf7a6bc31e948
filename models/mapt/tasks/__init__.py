"""Batched multi-agent tasks behind one protocol; numpy and MuJoCo alone."""

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
from mapt.tasks.mujoco_task import MujocoEntry
from mapt.tasks.pettingzoo_task import ParallelEntry
from mapt.tasks.protocol import DrawnTask, MaskingTask, Task, TaskEntry, TaskSpec, TaskStep, WrappedTask
from mapt.tasks.registry import agent_geoms, load_model, make_task, register_task, task_names, task_spec

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
