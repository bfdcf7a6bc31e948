"""Walker2d with one agent per leg or per joint.

Physics, reward and initial states are those of gymnasium's Walker2d-v5, the partition into legs that of MaMuJoCo.
"""

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.mujoco_definition import (
    Features,
    MujocoMdp,
    Robot,
    gymnasium_asset,
    locomotion_reward,
    negated,
    uniform_start,
)
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.partition import Partition, columns, hinge
from mapt.tasks.robots import hopper

FRAME_SKIP = 4
PHYSICS_STEP_SECONDS = 0.002
STEP_SECONDS = FRAME_SKIP * PHYSICS_STEP_SECONDS
CONTROL_COST_WEIGHT = 1e-3
HEALTHY_HEIGHT_METRES = (0.8, 2.0)
HEALTHY_ANGLE_RADIANS = 1.0
START_NOISE = 0.005
#: Speeds are clipped to [-10, 10] in the state, but not in observations.
STATE_SPEED_LIMIT = 10.0
#: Root x, root z, pitch and six joints.
NQ = NV = 9

RIGHT = ("foot_joint", "leg_joint", "thigh_joint")
LEFT = ("foot_left_joint", "leg_left_joint", "thigh_left_joint")
JOINTS = tuple(
    hinge(name, 3 + index, 3 + index, actuator=index) for index, name in enumerate((*RIGHT[::-1], *LEFT[::-1]))
)
EDGES = (
    *((leg[lower], leg[lower + 1]) for leg in (RIGHT, LEFT) for lower in (0, 1)),
    ("thigh_joint", "thigh_left_joint"),
)
INSTRUCTIONS = "The walker should walk or run to the right as fast as it can, upright and without falling over."


def healthy(features: Features) -> NDArray[np.bool_]:
    """(E,) bool: upright and with the torso's height in range."""
    low, high = HEALTHY_HEIGHT_METRES
    height, angle = features["qpos"][:, 1], features["qpos"][:, 2]
    return (low < height) & (height < high) & (np.abs(angle) < HEALTHY_ANGLE_RADIANS)


def clip_speeds(features: Features) -> None:
    """Write the clipped speeds of the state."""
    np.clip(features["qvel"], -STATE_SPEED_LIMIT, STATE_SPEED_LIMIT, out=features["state_qvel"])


MDP = MujocoMdp(
    frame_skip=FRAME_SKIP,
    sample_start=uniform_start(np.array([0.0, 1.25, *[0.0] * 7]), NV, START_NOISE),
    reward=locomotion_reward(STEP_SECONDS, CONTROL_COST_WEIGHT, healthy),
    terminated=negated(healthy),
    features={"state_qvel": (NV,)},
    compute=clip_speeds,
    state=columns("qpos", 1, NQ) + columns("state_qvel", 0, NV),
)


def _definition(conf: str, agents: tuple[tuple[str, ...], ...], names: tuple[str, ...]) -> MujocoDefinition:
    partition = Partition(JOINTS, EDGES, agents, columns("qpos", 1, 3) + columns("qvel", 0, 3))
    robot = Robot(gymnasium_asset("walker2d_v5.xml"), NQ, NV, PHYSICS_STEP_SECONDS, partition)
    return MujocoDefinition(f"Walker2d-{conf}", robot, MDP, names, INSTRUCTIONS, policy_settings=hopper.POLICY_SETTINGS)


TASKS = (
    _definition("2x3", (RIGHT, LEFT), ("right leg", "left leg")),
    _definition(
        "6x1",
        tuple((name,) for name in (*RIGHT, *LEFT)),
        ("right foot", "right shin", "right thigh", "left foot", "left shin", "left thigh"),
    ),
)
