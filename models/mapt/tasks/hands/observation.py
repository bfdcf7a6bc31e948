"""What the hands' agents observe: sensors of MuJoCo, scaled and clipped as in Bi-DexHands.

Sensors are read as at the start of the last physics substep, 1/240 s before the state that is stored. Each agent
observes its own hand and the object; the state is both hands and the object. The parts of a hand's 199 numbers:

| numbers | what |
|---|---|
| 24 | joint angles, scaled to [-1, 1] within their limits |
| 24 | joint velocities in rad/s, x 0.2 |
| 24 | actuator forces at the joints in Nm, x 10 |
| 5 x 13 | fingertips: position, quaternion, linear and angular velocity |
| 5 x 6 | force in N and torque in Nm at the fingertips, x 10 |
| 3 | position of the base |
| 3 | roll, pitch and yaw of the base relative to its first pose |
| 26 | the last action |

Positions are in metres, quaternions (w, x, y, z). Positions, orientations and velocities are in world coordinates,
forces and torques in the fingertip's.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from functools import cache

import mujoco
import numpy as np

from mapt.tasks.contact_forces import cross
from mapt.tasks.hands.model import (
    ACTION_ORDER,
    FINGERS,
    HAND_NQ,
    HAND_NV,
    N_ACTIONS,
    SIDES,
    FloatArray,
    joint_limits,
)
from mapt.tasks.mujoco_definition import Features
from mapt.tasks.partition import Joint, Partition, columns

#: Numbers that one hand observes of itself.
HAND_WIDTH = 199
ANGLES, VELOCITIES, FORCES = slice(0, 24), slice(24, 48), slice(48, 72)
TIPS, TIP_FORCES = slice(72, 137), slice(137, 167)
BASE, TURN, ACTION = slice(167, 170), slice(170, 173), slice(173, 199)
#: All that is sensed comes before what is computed.
SENSED = slice(0, BASE.stop)
#: Numbers of the sensors of both hands; those of the object follow.
N_HAND_SENSORS = len(SIDES) * BASE.stop

VELOCITY_SCALE, FORCE_SCALE = 0.2, 10.0
OBSERVATION_LIMIT = 5.0
#: Sensors of a moving body and what they are multiplied by.
_BODY_SENSORS = ("FRAMEPOS", "FRAMEQUAT", "FRAMELINVEL", "FRAMEANGVEL")
BODY_SCALE = np.array([1.0] * 10 + [VELOCITY_SCALE] * 3)


def add_hand_sensors(spec: mujoco.MjSpec, base_sites: tuple[str, str]) -> None:
    """Add the sensors of both hands, in the order of observations.

    Args:
        base_sites: per hand, the site that is observed as the position of its base.
    """
    for side, site in zip(SIDES, base_sites, strict=True):
        hinges = [joint.name for joint in spec.joints if joint.name.startswith(f"{side}_robot0:")]
        for kind in ("JOINTPOS", "JOINTVEL", "JOINTACTFRC"):
            for hinge in hinges:
                _add_sensor(spec, kind, "JOINT", hinge)
        for finger in FINGERS:
            add_body_sensors(spec, f"{side}_robot0:{finger}distal")
        for finger in FINGERS:
            for kind in ("FORCE", "TORQUE"):
                _add_sensor(spec, kind, "SITE", f"{side}_robot0:S_{finger}tip")
        add_position_sensor(spec, site)


def add_body_sensors(spec: mujoco.MjSpec, body: str) -> None:
    """Add 13 numbers: position, quaternion, linear and angular velocity of a body's frame."""
    for kind in _BODY_SENSORS:
        _add_sensor(spec, kind, "XBODY", body)


def add_pose_sensors(spec: mujoco.MjSpec, body: str) -> None:
    """Add 7 numbers: position and quaternion of a body's frame."""
    for kind in _BODY_SENSORS[:2]:
        _add_sensor(spec, kind, "XBODY", body)


def add_position_sensor(spec: mujoco.MjSpec, site: str) -> None:
    """Add 3 numbers: the position of a site."""
    _add_sensor(spec, "FRAMEPOS", "SITE", site)


def _add_sensor(spec: mujoco.MjSpec, kind: str, object_kind: str, name: str) -> None:
    spec.add_sensor(
        type=getattr(mujoco.mjtSensor, f"mjSENS_{kind}"),
        objtype=getattr(mujoco.mjtObj, f"mjOBJ_{object_kind}"),
        objname=name,
    )


@cache
def _scale_and_offset() -> tuple[FloatArray, FloatArray]:
    """(170,) each: what a hand's sensors are multiplied by, and what is then added."""
    low, high = joint_limits()
    scale, offset = np.ones(SENSED.stop), np.zeros(SENSED.stop)
    scale[ANGLES], offset[ANGLES] = 2 / (high - low), -(high + low) / (high - low)
    scale[VELOCITIES] = VELOCITY_SCALE
    scale[FORCES] = scale[TIP_FORCES] = FORCE_SCALE
    return scale, offset


def observe_hands(features: Features) -> None:
    """Write `hands` (E, 2, 199) from `qpos`, `ctrl` and `sensordata`."""
    hands, sensed = features["hands"], features["sensordata"][:, :N_HAND_SENSORS]
    scale, offset = _scale_and_offset()
    np.multiply(sensed.reshape(len(hands), len(SIDES), -1), scale, out=hands[:, :, SENSED])
    hands[:, :, SENSED] += offset
    bases = features["qpos"][:, : len(SIDES) * HAND_NQ].reshape(len(hands), len(SIDES), HAND_NQ)
    write_roll_pitch_yaw(bases[:, :, 3:7], hands[:, :, TURN])
    np.clip(hands[:, :, : ACTION.start], -OBSERVATION_LIMIT, OBSERVATION_LIMIT, out=hands[:, :, : ACTION.start])
    actions = features["ctrl"].reshape(len(hands), len(SIDES), N_ACTIONS)
    np.clip(actions[:, :, ACTION_ORDER], -1.0, 1.0, out=hands[:, :, ACTION])


def write_roll_pitch_yaw(quaternions: FloatArray, angles: FloatArray) -> None:
    """Write the angles (..., 3) in radians about the world's x, then y, then z axis of quaternions (..., 4)."""
    w, x, y, z = (quaternions[..., part] for part in range(4))
    angles[..., 0] = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    angles[..., 1] = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    angles[..., 2] = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def relative_quaternion(one: FloatArray, other: FloatArray) -> FloatArray:
    """(E, 4): the rotation from `other` to `one`, that is one * conj(other)."""
    a, b = one[:, :1], other[:, :1]
    u, v = one[:, 1:], other[:, 1:]
    return np.concatenate([a * b + np.vecdot(u, v)[:, None], b * u - a * v - cross(u, v)], axis=1)


def _joints(hand: int, side: str) -> tuple[Joint, ...]:
    """A hand's actuators in the order of its action. The first one stands for the whole hand's observation."""
    first = hand * HAND_WIDTH
    observed = columns("hands", first, first + HAND_WIDTH)
    return tuple(
        Joint(f"{side} {place}", hand * N_ACTIONS + actuator, own=observed if place == 0 else (), near=())
        for place, actuator in enumerate(ACTION_ORDER)
    )


def hand_partition(object_width: int) -> Partition:
    """One agent per hand, which observes its hand, then the `object_width` numbers of the feature `object`."""
    team = tuple(_joints(hand, side) for hand, side in enumerate(SIDES))
    return Partition(
        joints=(*team[0], *team[1]),
        edges=(),
        agents=tuple(tuple(joint.name for joint in joints) for joints in team),
        shared=columns("object", 0, object_width),
    )


def at_rest(n: int, more_qpos: int, more_qvel: int) -> tuple[FloatArray, FloatArray]:
    """qpos and qvel of n pairs of hands in their first pose, followed by zeros for the object."""
    qpos = np.zeros((n, len(SIDES) * HAND_NQ + more_qpos))
    qpos[:, [hand * HAND_NQ + 3 for hand in range(len(SIDES))]] = 1.0
    return qpos, np.zeros((n, len(SIDES) * HAND_NV + more_qvel))
