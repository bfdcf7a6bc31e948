"""Batched multi-agent tasks behind one protocol. Needs numpy and MuJoCo only."""

from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.pettingzoo_task import PettingZooDefinition
from mapt.tasks.protocol import (
    Drawing,
    DrawnDefinition,
    MaskingTask,
    RenderableTask,
    Task,
    TaskDefinition,
    TaskSpec,
    TaskStep,
    WrappedTask,
)
from mapt.tasks.registry import (
    agent_geoms,
    find_drawing,
    frame_rate_hz,
    load_model,
    make_task,
    register_task,
    task_names,
    task_spec,
)

__all__ = [
    "Drawing",
    "DrawnDefinition",
    "MaskingTask",
    "MujocoDefinition",
    "PettingZooDefinition",
    "RenderableTask",
    "Task",
    "TaskDefinition",
    "TaskSpec",
    "TaskStep",
    "WrappedTask",
    "agent_geoms",
    "find_drawing",
    "frame_rate_hz",
    "load_model",
    "make_task",
    "register_task",
    "task_names",
    "task_spec",
]
