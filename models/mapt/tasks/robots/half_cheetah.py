"""HalfCheetah with one agent per joint or per leg.

Physics, reward and initial states are those of gymnasium's HalfCheetah-v5, the partitions those of gymnasium-robotics'
MaMuJoCo.
"""

import numpy as np

from mapt.tasks.mujoco_definition import (
    MujocoMdp,
    Robot,
    gymnasium_asset,
    locomotion_reward,
    uniform_start,
)
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.partition import Partition, columns, hinge

FRAME_SKIP = 5
PHYSICS_STEP_SECONDS = 0.01
STEP_SECONDS = FRAME_SKIP * PHYSICS_STEP_SECONDS
CONTROL_COST_WEIGHT = 0.1
#: Root x, root z, pitch and six joints.
NQ = NV = 9

JOINTS = tuple(
    hinge(name, 3 + index, 3 + index, actuator=index)
    for index, name in enumerate(("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"))
)
EDGES = (("bfoot", "bshin"), ("bshin", "bthigh"), ("bthigh", "fthigh"), ("fthigh", "fshin"), ("fshin", "ffoot"))
INSTRUCTIONS = (
    "The cheetah should run forwards, to the right, as fast as it can. "
    "Smooth strides on its feet are better than flailing or sliding on its back."
)


MDP = MujocoMdp(
    frame_skip=FRAME_SKIP,
    sample_start=uniform_start(np.zeros(NQ), NV, 0.1, normal_velocities=True),
    reward=locomotion_reward(STEP_SECONDS, CONTROL_COST_WEIGHT),
    state=columns("qpos", 1, NQ) + columns("qvel", 0, NV),
)


def _definition(conf: str, agents: tuple[tuple[str, ...], ...], names: tuple[str, ...]) -> MujocoDefinition:
    # without root x, the distance covered
    shared = columns("qpos", 1, 3) + columns("qvel", 0, 3)
    partition = Partition(JOINTS, EDGES, agents, shared)
    robot = Robot(gymnasium_asset("half_cheetah.xml"), NQ, NV, PHYSICS_STEP_SECONDS, partition, total_mass_kg=14.0)
    return MujocoDefinition(f"HalfCheetah-{conf}", robot, MDP, names, INSTRUCTIONS)


TASKS = (
    _definition(
        "6x1",
        tuple((joint.name,) for joint in JOINTS),
        ("back thigh", "back shin", "back foot", "front thigh", "front shin", "front foot"),
    ),
    _definition("2x3", (("bthigh", "bshin", "bfoot"), ("fthigh", "fshin", "ffoot")), ("back leg", "front leg")),
)
