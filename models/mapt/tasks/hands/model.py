"""The MuJoCo model of two floating Shadow hands, of which the left one is the mirror image of the right one.

The hand is gymnasium-robotics' (Apache-2.0, see LICENSE.md among its assets). Its base is pushed and turned by forces
in world coordinates against a damping that is as strong as the linear and angular damping of 100 per second in Isaac
Gym. Gravity does not act on the hands.

All actions are in [-1, 1]. The ranges of forces and joint angles are part of the model's actuators, so that `ctrl` is
the action, and MuJoCo clamps it.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.errors import TaskError

CONTROL_HZ = 60
SUBSTEPS = 4
STEP_SECONDS = 1 / CONTROL_HZ

SIDES = ("right", "left")
FINGERS = ("ff", "mf", "rf", "lf", "th")
#: Per hand: hinges, of which `N_TARGETS` have a position actuator, and entries of an action.
N_HINGES, N_TARGETS, N_ACTIONS = 24, 20, 26
#: Positions and velocities of a hand: three slides, a ball joint and the hinges.
HAND_NQ, HAND_NV = 7 + N_HINGES, 6 + N_HINGES
#: Positions of the entries of an action among a hand's actuators: force, torque, then joint targets.
ACTION_ORDER = (*range(N_TARGETS, N_ACTIONS), *range(N_TARGETS))

#: The discount is that of Bi-DexHands; episodes last for 75 or 250 steps.
POLICY_SETTINGS: Mapping[str, object] = {"learning_rate": 5e-4, "gamma": 0.96, "clip": 0.2}

#: Damping of the base: 100 per second times a hand's mass in kg, and times a moment of inertia in kg m^2.
SLIDE_DAMPING, BALL_DAMPING = 100 * 4.6, 100 * 0.2
#: The base is massless but for what keeps the mass matrix regular.
_BASE_MASS, _SLIDE_INERTIA, _BALL_INERTIA = 1e-3, 1e-6, 1e-5
_SOLVER_ITERATIONS = 20
#: The bit of `contype` and `conaffinity` by which the hands touch each other.
_OTHER_HAND = 2
#: The group of sites that are not drawn.
HIDDEN = 4
#: An element of the asset's names, for example robot0:ffdistal.
_ASSET_PREFIX = "robot0:"
_MIRROR = np.array([-1.0, 1.0, 1.0])
_MIRROR_QUATERNION = np.array([1.0, 1.0, -1.0, -1.0])

FloatArray = NDArray[np.float64]
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the base of a hand starts."""

    position: Vector
    #: Rotation about the world's x, then y, then z axis in radians.
    angles: Vector


@dataclass(frozen=True, slots=True)
class Strength:
    """Largest force in N and torque in Nm on a base.

    Bi-DexHands scales an action by the time step and 1e5 for forces, 1e3 for torques.
    """

    force: float
    torque: float

    @classmethod
    def scaled(cls, force_scale: float, torque_scale: float) -> "Strength":
        return cls(force_scale * 1e5 * STEP_SECONDS, torque_scale * 1e3 * STEP_SECONDS)


def hand_asset() -> Path:
    """The path of gymnasium-robotics' hand. Does not import gymnasium-robotics.

    Raises:
        TaskError: if gymnasium-robotics is not installed or lacks the file.
    """
    package = find_spec("gymnasium_robotics")
    if package is None or package.origin is None:
        raise TaskError("gymnasium-robotics is not installed. The model of the hand is among its assets.")
    path = Path(package.origin).parent / "envs" / "assets" / "hand" / "reach.xml"
    if not path.is_file():
        raise TaskError(f"{path} is missing. Reinstall gymnasium-robotics.")
    return path


def rotation(angles: Vector) -> FloatArray:
    """The quaternion (w, x, y, z) of rotations about the world's x, then y, then z axis in radians."""
    quaternion = np.zeros(4)
    mujoco.mju_euler2Quat(quaternion, np.array(angles), "XYZ")
    return quaternion


@cache
def joint_limits() -> tuple[FloatArray, FloatArray]:
    """Lowest and highest angles (24,) in radians of a hand's hinges."""
    low, high = np.array([joint.range for joint in mujoco.MjSpec.from_file(str(hand_asset())).joints]).T
    return low, high


def two_hands(right: Pose, left: Pose, strength: Strength, view: Sequence[float]) -> mujoco.MjSpec:
    """A floor and two hands without sensors. Names of a hand's parts start with `right_` or `left_`.

    Args:
        view: of clips, see `mapt.rendering.camera.CLIP_VIEW`.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = STEP_SECONDS / SUBSTEPS
    spec.option.iterations = _SOLVER_ITERATIONS
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1])
    spec.worldbody.add_light(pos=[0, 0, 3], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    spec.add_numeric(name="clip_view", data=view, size=len(view))
    for side, pose in zip(SIDES, (right, left), strict=True):
        _add_hand(spec, side, pose, strength)
    return spec


def _add_hand(spec: mujoco.MjSpec, side: str, pose: Pose, strength: Strength) -> None:
    base = spec.worldbody.add_body(name=f"{side}_slides", pos=pose.position)
    _set_mass(base, _SLIDE_INERTIA)
    for name, axis in zip("xyz", np.eye(3), strict=True):
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        base.add_joint(name=f"{side}_{name}", type=slide, axis=axis, damping=SLIDE_DAMPING)
    turn = base.add_body(name=f"{side}_base")
    _set_mass(turn, _BALL_INERTIA)
    turn.add_site(name=f"{side}_base", group=HIDDEN)
    turn.add_joint(name=f"{side}_ball", type=mujoco.mjtJoint.mjJNT_BALL, damping=BALL_DAMPING)
    mount = _hand_spec(spec, mirrored=side == "left").body(f"{_ASSET_PREFIX}hand mount")
    turn.add_frame(quat=rotation(pose.angles)).attach_body(mount, f"{side}_", "")
    for body in spec.bodies:
        if body.name.startswith(side):
            body.gravcomp = 1
            for geom in body.geoms:
                _let_hands_collide(geom, side)
    for name in "xyz":
        _add_motor(spec, f"{side}_force_{name}", f"{side}_{name}", 0, strength.force)
    for axis, name in enumerate("xyz"):
        _add_motor(spec, f"{side}_torque_{name}", f"{side}_ball", axis, strength.torque)


def _let_hands_collide(geom: mujoco.MjsGeom, side: str) -> None:
    """Let a solid part of a hand touch the other hand; in the asset, it touches objects only."""
    if geom.contype:
        if side == "left":
            geom.conaffinity = _OTHER_HAND
        else:
            geom.contype |= _OTHER_HAND


def _set_mass(body: mujoco.MjsBody, inertia: float) -> None:
    body.mass, body.inertia, body.explicitinertial = _BASE_MASS, [inertia] * 3, True


def _add_motor(spec: mujoco.MjSpec, name: str, joint: str, axis: int, limit: float) -> None:
    """A force or torque of up to `limit` in world coordinates."""
    gear = np.zeros(6)
    gear[axis] = 1.0
    motor = spec.add_actuator(
        name=name,
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINTINPARENT,
        gear=gear,
        ctrllimited=True,
        ctrlrange=[-1.0, 1.0],
    )
    motor.gainprm[0] = limit


def _hand_spec(parent: mujoco.MjSpec, *, mirrored: bool) -> mujoco.MjSpec:
    """The asset's hand alone, at the origin, with controls in [-1, 1]."""
    spec = mujoco.MjSpec.from_file(str(hand_asset()))
    # MuJoCo warns about options that differ from those of the model to which the hand is attached.
    spec.option.timestep = parent.option.timestep
    for size in ("njmax", "nconmax", "nuser_jnt", "nuser_site", "nuser_tendon", "nuser_sensor", "nuser_actuator"):
        setattr(spec, size, -1)
    for element in (*spec.sensors, *spec.lights, *spec.worldbody.geoms):
        spec.delete(element)
    spec.body(f"{_ASSET_PREFIX}hand mount").pos = np.zeros(3)
    if mirrored:
        _mirror(spec)
    for actuator in spec.actuators:
        low, high = actuator.ctrlrange
        stiffness, half = actuator.gainprm[0], (high - low) / 2
        actuator.gainprm[0], actuator.biasprm[0] = stiffness * half, stiffness * (low + high) / 2
        actuator.ctrlrange = [-1.0, 1.0]
    return spec


def _mirror(spec: mujoco.MjSpec) -> None:
    """Reflect the hand in the plane x = 0 of its own frame. Angles of joints keep their sign."""
    for mesh in spec.meshes:
        mesh.scale = mesh.scale * _MIRROR
    for body in spec.bodies[1:]:
        body.pos, body.quat = body.pos * _MIRROR, _quaternion(spec, body.quat, body.alt) * _MIRROR_QUATERNION
        body.ipos, body.iquat = body.ipos * _MIRROR, _quaternion(spec, body.iquat, body.ialt) * _MIRROR_QUATERNION
        for alternative in (body.alt, body.ialt):
            alternative.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        for part in (*body.geoms, *body.sites):
            part.pos, part.quat = part.pos * _MIRROR, _quaternion(spec, part.quat, part.alt) * _MIRROR_QUATERNION
            part.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        for joint in body.joints:
            joint.axis = -joint.axis * _MIRROR


def _quaternion(spec: mujoco.MjSpec, quaternion: Sequence[float], alternative: mujoco.MjsOrientation) -> FloatArray:
    """The quaternion of an orientation that the asset gives in another form."""
    if alternative.type == mujoco.mjtOrientation.mjORIENTATION_QUAT:
        return np.array(quaternion)
    compiler = spec.compiler
    return np.array(
        spec.resolve_orientation(degree=compiler.degree, sequence=compiler.eulerseq, orientation=alternative)
    )
