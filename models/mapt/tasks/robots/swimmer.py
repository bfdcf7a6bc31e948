"""Swimmer run by two agents of one joint each: gymnasium's Swimmer-v5, with MaMuJoCo's partition."""

import numpy as np

from mapt.tasks.mujoco_definition import (
    Float64s,
    Frame,
    MujocoRules,
    MujocoScene,
    gymnasium_asset,
    squared,
    uniform_about,
)
from mapt.tasks.mujoco_task import MujocoEntry
from mapt.tasks.partition import Joint, Partition, columns

FRAME_SKIP = 4
PHYSICS_STEP_SECONDS = 0.01
STEP_SECONDS = FRAME_SKIP * PHYSICS_STEP_SECONDS
CONTROL_COST_WEIGHT = 1e-4
START_NOISE = 0.1
INSTRUCTIONS = "The swimmer should swim to the right as fast as it can, in even strokes."


def reward(before: Frame, after: Frame, controls: Float64s) -> Float64s:
    """Forward speed less the cost of the controls."""
    speed = (after["qpos"][:, 0] - before["qpos"][:, 0]) / STEP_SECONDS
    return speed - CONTROL_COST_WEIGHT * squared(controls)


def rules(n_joints: int) -> MujocoRules:
    """The rules for a swimmer of this many driven joints, after x, y and heading."""
    size = 3 + n_joints
    return MujocoRules(
        frame_skip=FRAME_SKIP,
        draw_start=uniform_about(np.zeros(size), size, START_NOISE),
        reward=reward,
        state=columns("qpos", 2, size) + columns("qvel", 0, size),
    )


#: MaMuJoCo shows each agent two speeds: of the front tip along one axis, and of its joint.
_FRONT = Joint("motor1_rot", 0, own=(("qpos", 3), ("qvel", 0), ("qvel", 3)), near=(("qpos", 3),))
_BACK = Joint("motor2_rot", 1, own=(("qpos", 4), ("qvel", 1), ("qvel", 4)), near=(("qpos", 4),))
_PARTITION = Partition(
    joints=(_FRONT, _BACK),
    edges=((_FRONT.name, _BACK.name),),
    agents=((_FRONT.name,), (_BACK.name,)),
    shared=(("qpos", 2), ("qvel", 2)),
)

TASKS = (
    MujocoEntry(
        name="Swimmer-2x1",
        scene=MujocoScene(gymnasium_asset("swimmer.xml"), 5, 5, PHYSICS_STEP_SECONDS, _PARTITION),
        rules=rules(2),
        agent_names=("front joint", "back joint"),
        instructions=INSTRUCTIONS,
    ),
)
