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
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.pettingzoo_task import PettingZooDefinition
from mapt.tasks.protocol import MaskingTask, RenderableTask, Task, TaskDefinition, TaskSpec, TaskStep, WrappedTask
from mapt.tasks.registry import agent_geoms, load_model, make_task, register_task, task_names, task_spec

__all__ = [
    "InvalidAction",
    "InvalidSnapshot",
    "InvalidTaskOption",
    "MaskingTask",
    "MujocoDefinition",
    "NoPicture",
    "NoSimulator",
    "PettingZooDefinition",
    "RenderableTask",
    "Task",
    "TaskDefinition",
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
