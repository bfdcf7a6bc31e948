"""The built-in tasks that run on MuJoCo."""

from mapt.tasks import MujocoDefinition, task_names
from mapt.tasks.registry import find_definition

MUJOCO_TASKS = [name for name in task_names() if isinstance(find_definition(name), MujocoDefinition)]
