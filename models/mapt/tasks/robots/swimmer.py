"""Swimmer with one agent per joint: gymnasium's Swimmer-v5 with MaMuJoCo's partition."""

import numpy as np

from mapt.tasks.mujoco_definition import (
    MujocoMdp,
    Robot,
    gymnasium_asset,
    locomotion_reward,
    uniform_start,
)
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.partition import Joint, Partition, columns

FRAME_SKIP = 4
PHYSICS_STEP_SECONDS = 0.01
STEP_SECONDS = FRAME_SKIP * PHYSICS_STEP_SECONDS
CONTROL_COST_WEIGHT = 1e-4
START_NOISE = 0.1
INSTRUCTIONS = "The swimmer should swim to the right as fast as it can, in even strokes."


def mdp(n_joints: int) -> MujocoMdp:
    """The MDP of a swimmer with this many driven joints, which follow x, y and heading in qpos."""
    size = 3 + n_joints
    return MujocoMdp(
        frame_skip=FRAME_SKIP,
        sample_start=uniform_start(np.zeros(size), size, START_NOISE),
        reward=locomotion_reward(STEP_SECONDS, CONTROL_COST_WEIGHT),
        state=columns("qpos", 2, size) + columns("qvel", 0, size),
    )


#: As in MaMuJoCo, each agent observes two velocities: the front tip's along one axis, and its joint's.
_FRONT = Joint("motor1_rot", 0, own=(("qpos", 3), ("qvel", 0), ("qvel", 3)), near=(("qpos", 3),))
_BACK = Joint("motor2_rot", 1, own=(("qpos", 4), ("qvel", 1), ("qvel", 4)), near=(("qpos", 4),))
_PARTITION = Partition(
    joints=(_FRONT, _BACK),
    edges=((_FRONT.name, _BACK.name),),
    agents=((_FRONT.name,), (_BACK.name,)),
    shared=(("qpos", 2), ("qvel", 2)),
)

TASKS = (
    MujocoDefinition(
        name="Swimmer-2x1",
        robot=Robot(gymnasium_asset("swimmer.xml"), 5, 5, PHYSICS_STEP_SECONDS, _PARTITION),
        mdp=mdp(2),
        agent_names=("front joint", "back joint"),
        instructions=INSTRUCTIONS,
    ),
)
