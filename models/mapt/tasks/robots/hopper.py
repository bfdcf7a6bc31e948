"""Hopper with one agent per joint: gymnasium's Hopper-v5 with MaMuJoCo's partition."""

from collections.abc import Mapping

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
from mapt.tasks.partition import Joint, Partition, columns

FRAME_SKIP = 4
PHYSICS_STEP_SECONDS = 0.002
STEP_SECONDS = FRAME_SKIP * PHYSICS_STEP_SECONDS
CONTROL_COST_WEIGHT = 1e-3
HEALTHY_STATE = 100.0
HEALTHY_HEIGHT_METRES = 0.7
HEALTHY_ANGLE_RADIANS = 0.2
START_NOISE = 0.005
#: Observed speeds are clipped to [-10, 10].
SPEED_LIMIT = 10.0
#: Root x, root z, pitch and three joints.
NQ = NV = 6


def healthy(features: Features) -> NDArray[np.bool_]:
    """(E,) bool: upright, high enough and with all numbers in range."""
    qpos, qvel = features["qpos"], features["qvel"]
    bounded = (np.abs(qpos[:, 2:]) < HEALTHY_STATE).all(axis=1) & (np.abs(qvel) < HEALTHY_STATE).all(axis=1)
    return bounded & (qpos[:, 1] > HEALTHY_HEIGHT_METRES) & (np.abs(qpos[:, 2]) < HEALTHY_ANGLE_RADIANS)


def clip_speeds(features: Features) -> None:
    """Write the clipped speeds that agents observe."""
    np.clip(features["qvel"], -SPEED_LIMIT, SPEED_LIMIT, out=features["clipped_qvel"])


MDP = MujocoMdp(
    frame_skip=FRAME_SKIP,
    sample_start=uniform_start(np.array([0.0, 1.25, 0.0, 0.0, 0.0, 0.0]), NV, START_NOISE),
    reward=locomotion_reward(STEP_SECONDS, CONTROL_COST_WEIGHT, healthy),
    terminated=negated(healthy),
    features={"clipped_qvel": (NV,)},
    compute=clip_speeds,
    state=columns("qpos", 1, NQ) + columns("clipped_qvel", 0, NV),
)


def _joint(name: str, actuator: int) -> Joint:
    index = 3 + actuator
    return Joint(name, actuator, own=(("qpos", index), ("clipped_qvel", index)), near=(("qpos", index),))


#: With a discount of 0.99, a fast gait that falls after 300 steps is worth more than one that does not fall; with
#: 0.998 from the start, some policies stand still. With one that rises, they hop first and then learn not to fall.
POLICY_SETTINGS: Mapping[str, object] = {"learning_rate": 5e-4, "gamma": 0.998, "gamma_steps": 1_500_000}

_NAMES = ("thigh_joint", "leg_joint", "foot_joint")
_PARTITION = Partition(
    joints=tuple(_joint(name, actuator) for actuator, name in enumerate(_NAMES)),
    edges=(("foot_joint", "leg_joint"), ("leg_joint", "thigh_joint")),
    agents=tuple((name,) for name in _NAMES),
    shared=columns("qpos", 1, 3) + columns("clipped_qvel", 0, 3),
)

TASKS = (
    MujocoDefinition(
        name="Hopper-3x1",
        robot=Robot(gymnasium_asset("hopper.xml"), NQ, NV, PHYSICS_STEP_SECONDS, _PARTITION),
        mdp=MDP,
        agent_names=("thigh", "leg", "foot"),
        instructions="The hopper should hop to the right as fast as it can, without falling over.",
        policy_settings=POLICY_SETTINGS,
    ),
)
