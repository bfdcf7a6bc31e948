"""Humanoid and HumanoidStandup with one agent each for the upper and the lower body, or one per joint.

Physics, rewards and initial states are those of gymnasium's Humanoid-v5 and HumanoidStandup-v5. The partition in two
is that of MaMuJoCo.
"""

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.mujoco_definition import (
    Features,
    FloatArray,
    MujocoMdp,
    Robot,
    gymnasium_asset,
    never_terminated,
    sum_of_squares,
    uniform_start,
)
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.partition import FeatureColumn, Joint, Partition, columns

FRAME_SKIP = 5
PHYSICS_STEP_SECONDS = 0.003
STEP_SECONDS = FRAME_SKIP * PHYSICS_STEP_SECONDS
FORWARD_WEIGHT = 1.25
CONTROL_COST_WEIGHT = 0.1
CONTACT_COST_WEIGHT = 5e-7
CONTACT_COST_LIMIT = 10.0
HEALTHY_REWARD = 5.0
HEALTHY_HEIGHT_METRES = (1.0, 2.0)
START_NOISE = 0.01
ACTION_LIMIT = 0.4
NQ, NV, N_BODIES = 24, 23, 14
#: Fields per body and their sizes: inertia and mass, spatial velocity, external force.
BODY_FIELDS = {"cinert": 10, "cvel": 6, "cfrc_ext": 6}

_TRUNK, _RIGHT_ARM, _LEFT_ARM = (1, 2, 3), (1, 10, 11), (1, 12, 13)
#: Joints in the order of their motors: name, index from the end of qpos and qvel, bodies observed with it. MaMuJoCo
#: swaps the first two: with what it calls abdomen_y, agents observe the angle of abdomen_z.
_JOINTS = (
    ("abdomen_y", 17, _TRUNK),
    ("abdomen_z", 16, _TRUNK),
    ("abdomen_x", 15, (3, 4, 7)),
    ("right_hip_x", 14, (4, 5)),
    ("right_hip_z", 13, (4, 5)),
    ("right_hip_y", 12, (4, 5)),
    ("right_knee", 11, (5, 6)),
    ("left_hip_x", 10, (7, 8)),
    ("left_hip_z", 9, (7, 8)),
    ("left_hip_y", 8, (7, 8)),
    ("left_knee", 7, (8, 9)),
    ("right_shoulder1", 6, _RIGHT_ARM),
    ("right_shoulder2", 5, _RIGHT_ARM),
    ("right_elbow", 4, (11,)),
    ("left_shoulder1", 3, _LEFT_ARM),
    ("left_shoulder2", 2, _LEFT_ARM),
    ("left_elbow", 1, (13,)),
)
ABDOMEN = ("abdomen_x", "abdomen_y", "abdomen_z")
RIGHT_HIP, LEFT_HIP = (tuple(f"{side}_hip_{axis}" for axis in "xyz") for side in ("right", "left"))
RIGHT_SHOULDER, LEFT_SHOULDER = (tuple(f"{side}_shoulder{axis}" for axis in "12") for side in ("right", "left"))
EDGES = (
    ABDOMEN,
    RIGHT_HIP,
    LEFT_HIP,
    ("left_elbow", *LEFT_SHOULDER),
    ("right_elbow", *RIGHT_SHOULDER),
    ("left_knee", *LEFT_HIP),
    ("right_knee", *RIGHT_HIP),
    (*LEFT_SHOULDER, *ABDOMEN),
    (*RIGHT_SHOULDER, *ABDOMEN),
    (*ABDOMEN, *LEFT_HIP),
    (*ABDOMEN, *RIGHT_HIP),
)
ARMS = (*RIGHT_SHOULDER, "right_elbow", *LEFT_SHOULDER, "left_elbow")
LEGS = tuple(f"{side}_{joint}" for side in ("right", "left") for joint in ("hip_x", "hip_y", "hip_z", "knee"))


def _joint(actuator: int, name: str, from_end: int, bodies: tuple[int, ...]) -> Joint:
    qpos, qvel = NQ - from_end, NV - from_end
    inertia, velocity, force = (
        tuple(column for body in bodies for column in columns(field, width * body, width * (body + 1)))
        for field, width in BODY_FIELDS.items()
    )
    own: tuple[FeatureColumn, ...] = (
        ("qpos", qpos),
        ("qvel", qvel),
        *inertia,
        *velocity,
        ("qfrc_actuator", qvel),
        *force,
    )
    return Joint(name, actuator, own, near=(("qpos", qpos),))


def fallen(features: Features) -> NDArray[np.bool_]:
    """(E,) bool: the torso's height is out of range."""
    low, high = HEALTHY_HEIGHT_METRES
    height = features["qpos"][:, 2]
    return ~((low < height) & (height < high))


def contact_cost(features: Features) -> FloatArray:
    """Weighted sum of squares of the contact forces, limited to `CONTACT_COST_LIMIT`: (E,)."""
    return np.minimum(CONTACT_COST_WEIGHT * sum_of_squares(features["cfrc_ext"]), CONTACT_COST_LIMIT)


def walking_reward(before: Features, after: Features, controls: FloatArray) -> FloatArray:
    """Forward speed of the centre of mass, plus 5 per step without a fall, minus the costs."""
    whole = 0
    speed = (after["subtree_com"][:, whole, 0] - before["subtree_com"][:, whole, 0]) / STEP_SECONDS
    costs = CONTROL_COST_WEIGHT * sum_of_squares(controls) + contact_cost(after)
    return FORWARD_WEIGHT * speed + HEALTHY_REWARD * ~fallen(after) - costs


def standing_reward(_before: Features, after: Features, controls: FloatArray) -> FloatArray:
    """Height of the torso divided by the physics step, plus 1, minus the costs."""
    height = after["qpos"][:, 2] / PHYSICS_STEP_SECONDS
    return height - CONTROL_COST_WEIGHT * sum_of_squares(controls) - contact_cost(after) + 1.0


_STATE = (
    columns("qpos", 2, NQ)
    + columns("qvel", 0, NV)
    + columns("cinert", 10, 10 * N_BODIES)
    + columns("cvel", 6, 6 * N_BODIES)
    + columns("qfrc_actuator", 6, NV)
    + columns("cfrc_ext", 6, 6 * N_BODIES)
)
_FIELDS = {
    **{name: (N_BODIES, width) for name, width in BODY_FIELDS.items()},
    "qfrc_actuator": (NV,),
    "subtree_com": (N_BODIES, 3),
}


def _pose(height_metres: float, quaternion: tuple[float, float, float, float]) -> FloatArray:
    return np.array([0.0, 0.0, height_metres, *quaternion, *[0.0] * (NQ - 7)])


WALKING = MujocoMdp(
    frame_skip=FRAME_SKIP,
    sample_start=uniform_start(_pose(1.4, (1.0, 0.0, 0.0, 0.0)), NV, START_NOISE),
    reward=walking_reward,
    terminated=fallen,
    previous=("subtree_com",),
    fields=_FIELDS,
    state=_STATE,
)
STANDING = MujocoMdp(
    frame_skip=FRAME_SKIP,
    sample_start=uniform_start(_pose(0.105, (1.0, 0.0, 0.0, 0.0)), NV, START_NOISE),
    reward=standing_reward,
    terminated=never_terminated,
    previous=(),
    fields=_FIELDS,
    state=_STATE,
)


def _definitions(body: str, asset: str, mdp: MujocoMdp, instructions: str) -> tuple[MujocoDefinition, ...]:
    joints = tuple(_joint(actuator, *joint) for actuator, joint in enumerate(_JOINTS))
    shared = columns("qpos", 2, 7) + columns("qvel", 0, 6)
    alone = (*ABDOMEN, *LEGS, *ARMS)
    teams = {
        "9|8": (((*ABDOMEN, *ARMS), LEGS), ("upper body", "lower body")),
        "17x1": (tuple((name,) for name in alone), tuple(name.replace("_", " ") for name in alone)),
    }
    return tuple(
        MujocoDefinition(
            name=f"{body}-{conf}",
            robot=Robot(
                gymnasium_asset(asset),
                NQ,
                NV,
                PHYSICS_STEP_SECONDS,
                Partition(joints, EDGES, agents, shared, frozenset(BODY_FIELDS)),
            ),
            mdp=mdp,
            agent_names=names,
            instructions=instructions,
            action_limit=ACTION_LIMIT,
        )
        for conf, (agents, names) in teams.items()
    )


TASKS = (
    *_definitions(
        "Humanoid",
        "humanoid.xml",
        WALKING,
        "The humanoid should walk or run to the right as fast as it can, upright and without falling over.",
    ),
    *_definitions(
        "HumanoidStandup",
        "humanoidstandup.xml",
        STANDING,
        "The humanoid lies on the ground. It should stand up, as high as it can, and stay up.",
    ),
)
