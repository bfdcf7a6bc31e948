"""Bi-DexHands' CatchOver2Underarm: one hand throws an egg, the other one catches it with the palm up."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.tasks.hands.definition import hands_task
from mapt.tasks.hands.model import (
    HAND_NQ,
    SIDES,
    FloatArray,
    Pose,
    Strength,
    two_hands,
)
from mapt.tasks.hands.observation import (
    BASE,
    BODY_SCALE,
    N_HAND_SENSORS,
    OBSERVATION_LIMIT,
    add_body_sensors,
    add_hand_sensors,
    add_pose_sensors,
    at_rest,
    observe_hands,
    relative_quaternion,
)
from mapt.tasks.mujoco_definition import Features

HANDS = (Pose((0.0, 0.0, 0.5), (1.67, 3.14, 0.0)), Pose((0.0, -0.8, 0.5), (0.0, 0.0, 3.1415)))
#: From the right hand's palm side: both hands, the goal between them and the egg in the air.
VIEW = (0.0, -0.37, 0.66, 1.0, 180.0, 18.0)
STRENGTH = Strength.scaled(0.1, 2.0)
EGG_START, GOAL = (0.0, 0.05, 1.0), (0.0, -0.4, 0.55)
EGG_SEMI_AXES, EGG_DENSITY = (0.03, 0.03, 0.04), 500.0
EGG_COLOUR, GOAL_COLOUR = (0.95, 0.93, 0.85, 1.0), (0.3, 0.85, 0.4, 0.45)
#: An episode ends when a base is this far from its first position, or the egg this low, in metres.
BASE_LIMIT_METRES, LOWEST_METRES = 0.1, 0.3
#: An egg this near to its goal has been caught.
CAUGHT_METRES = 0.05

#: The object's observation: the egg's pose and velocities, the goal's pose, and the rotation from goal to egg.
N_SENSED, OBJECT_WIDTH = 20, 24
EGG, GOAL_POSE, TURN = slice(0, 13), slice(13, 20), slice(20, 24)
#: The egg's free joint, then the goal's ball joint.
EGG_QPOS = len(SIDES) * HAND_NQ
GOAL_QPOS = EGG_QPOS + 7
#: Positions and velocities of both joints.
THINGS_NQ, THINGS_NV = 7 + 4, 6 + 3


def make_spec() -> mujoco.MjSpec:
    """Two hands, an egg and its goal.

    The goal turns on a ball joint, so that its orientation is part of the positions, from which clips are rendered.
    """
    spec = two_hands(*HANDS, STRENGTH, VIEW)
    egg = spec.worldbody.add_body(name="egg", pos=EGG_START)
    egg.add_freejoint()
    egg.add_geom(
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=EGG_SEMI_AXES, density=EGG_DENSITY, condim=4, rgba=EGG_COLOUR
    )
    goal = spec.worldbody.add_body(name="goal", pos=GOAL, gravcomp=1)
    goal.add_joint(type=mujoco.mjtJoint.mjJNT_BALL)
    goal.add_geom(type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=EGG_SEMI_AXES, contype=0, conaffinity=0, rgba=GOAL_COLOUR)
    add_hand_sensors(spec, ("right_base", "left_base"))
    add_body_sensors(spec, "egg")
    add_pose_sensors(spec, "goal")
    return spec


def sample_start(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    """Hands and egg always in the same place; egg and goal turned by random angles about y, then x."""
    qpos, qvel = at_rest(n, THINGS_NQ, THINGS_NV)
    qpos[:, EGG_QPOS : EGG_QPOS + 3] = EGG_START
    for first in (EGG_QPOS + 3, GOAL_QPOS):
        half = rng.uniform(-np.pi / 2, np.pi / 2, (2, n))
        (cos_x, cos_y), (sin_x, sin_y) = np.cos(half), np.sin(half)
        qpos[:, first : first + 4] = np.stack([cos_x * cos_y, sin_x * cos_y, cos_x * sin_y, sin_x * sin_y], axis=1)
    return qpos, qvel


def compute(features: Features) -> None:
    """Write `hands` and `object` (E, 24)."""
    observe_hands(features)
    thing, sensed = features["object"], features["sensordata"][:, N_HAND_SENSORS:]
    thing[:, : TURN.start] = sensed
    thing[:, EGG] *= BODY_SCALE
    thing[:, TURN] = relative_quaternion(sensed[:, 3:7], sensed[:, 16:20])
    np.clip(thing, -OBSERVATION_LIMIT, OBSERVATION_LIMIT, out=thing)


def reward(_before: Features, after: Features, _controls: FloatArray) -> FloatArray:
    """1 when the egg is at the goal and turned like it, less the farther it is away in position and angle."""
    thing = after["object"]
    distance = np.linalg.norm(thing[:, 13:16] - thing[:, 0:3], axis=1)
    angle = 2 * np.arcsin(np.minimum(np.linalg.norm(thing[:, 21:24], axis=1), 1.0))
    return np.exp(-0.2 * (20 * distance + angle))


def terminated(features: Features) -> NDArray[np.bool_]:
    """Whether a base has moved too far or the egg is too low, (E,)."""
    first = np.array([pose.position for pose in HANDS])
    moved = np.linalg.norm(features["hands"][:, :, BASE] - first, axis=2)
    return (moved >= BASE_LIMIT_METRES).any(axis=1) | (features["object"][:, 2] <= LOWEST_METRES)


def caught(features: Features) -> NDArray[np.bool_]:
    """Whether the egg is at its goal, (E,)."""
    thing = features["object"]
    return np.linalg.norm(thing[:, 13:16] - thing[:, 0:3], axis=1) < CAUGHT_METRES


TASKS = (
    hands_task(
        "CatchOver2Underarm",
        make_spec,
        object_nq=THINGS_NQ,
        object_nv=THINGS_NV,
        object_width=OBJECT_WIDTH,
        n_object_sensors=N_SENSED,
        sample_start=sample_start,
        compute=compute,
        reward=reward,
        terminated=terminated,
        success=caught,
        instructions="The right hand should throw the egg, and the left hand should catch it at the green place.",
        horizon_steps=75,
    ),
)
