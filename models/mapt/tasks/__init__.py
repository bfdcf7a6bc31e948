"""Batched multi-agent tasks behind one protocol; numpy and MuJoCo alone."""

from mapt.tasks.errors import InvalidAction, InvalidSnapshot, InvalidTaskOption, TaskError, UnknownTask
from mapt.tasks.protocol import Task, TaskSpec, TaskStep
from mapt.tasks.registry import agent_geoms, load_model, make_task, task_names, task_spec

__all__ = [
    "InvalidAction",
    "InvalidSnapshot",
    "InvalidTaskOption",
    "Task",
    "TaskError",
    "TaskSpec",
    "TaskStep",
    "UnknownTask",
    "agent_geoms",
    "load_model",
    "make_task",
    "task_names",
    "task_spec",
]
