"""Robots with any number of segments: MaMuJoCo's ManySegmentSwimmer and ManySegmentAnt, N agents of M segments each.

Rewards and terminations are those of gymnasium's Swimmer-v5 and Ant-v5. The models are assembled here within the
scenes of gymnasium's swimmer.xml and ant.xml.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import re
from collections.abc import Callable
from functools import partial
from itertools import pairwise

import mujoco

from mapt.tasks.mujoco_definition import Robot, gymnasium_asset
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.partition import Joint, Partition, hinge
from mapt.tasks.robots import ant, swimmer

_CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE
_HINGE = mujoco.mjtJoint.mjJNT_HINGE
_LIMITED = mujoco.mjtLimited.mjLIMITED_TRUE
_MOTOR_GEAR = 150.0


def definition(name: str) -> MujocoDefinition | None:
    """The task with a name such as ManySegmentAnt-2x3, or None if the name is of another form."""
    match = re.fullmatch(r"(ManySegmentSwimmer|ManySegmentAnt)-([1-9]\d?)x([1-9]\d?)", name)
    if match is None or int(match[2]) * int(match[3]) < 2:
        return None
    return _FAMILIES[match[1]](int(match[2]), int(match[3]))


def _swimmer(n_agents: int, per_agent: int) -> MujocoDefinition:
    n = n_agents * per_agent
    names = [f"rot{index}" for index in range(n)]
    partition = Partition(
        joints=tuple(hinge(name, 3 + index, 3 + index, actuator=index) for index, name in enumerate(names)),
        edges=tuple(pairwise(names)),
        agents=tuple(tuple(names[first : first + per_agent]) for first in range(0, n, per_agent)),
        shared=(),
    )
    robot = Robot(partial(swimmer_spec, n), 3 + n, 3 + n, swimmer.PHYSICS_STEP_SECONDS, partition)
    return MujocoDefinition(
        name=f"ManySegmentSwimmer-{n_agents}x{per_agent}",
        robot=robot,
        mdp=swimmer.mdp(n),
        agent_names=_numbered(n_agents),
        instructions=swimmer.INSTRUCTIONS,
    )


def swimmer_spec(n_joints: int) -> mujoco.MjSpec:
    """A chain of this many driven joints behind a torso that slides and rotates."""
    spec = gymnasium_asset("swimmer.xml")()
    _delete_parts(spec, "mid")
    spec.joint("free_body_rot").name = "rot"
    body = spec.body("torso")
    for index in range(n_joints):
        last = index == n_joints - 1
        body = body.add_body(name="back" if last else f"mid{index}", pos=[0.5 if index == 0 else -1.0, 0.0, 0.0])
        body.add_geom(type=_CAPSULE, fromto=[0, 0, 0, -1, 0, 0], size=[0.1, 0, 0], density=1000.0)
        # The first and last axes point up; those between alternate.
        axis = 1.0 if index == 0 or last else (-1.0) ** (index + 1)
        body.add_joint(name=f"rot{index}", type=_HINGE, axis=[0, 0, axis], limited=_LIMITED, range=[-100, 100])
    _add_motors(spec, [f"rot{index}" for index in range(n_joints)])
    return spec


#: x and y of the leg's direction, the ankle's axis and its range in degrees.
_Leg = tuple[float, float, list[float], list[float]]
_FRONT_LEGS: tuple[_Leg, _Leg] = ((0.2, 0.2, [-1, 1, 0], [30, 70]), (0.2, -0.2, [1, 1, 0], [30, 70]))
_OTHER_LEGS: tuple[_Leg, _Leg] = ((-0.2, 0.2, [1, 1, 0], [-70, -30]), (-0.2, -0.2, [-1, 1, 0], [-70, -30]))
_ANT_JOINTS = ("hip1", "ankle1", "hip2", "ankle2")


def ant_spec(n_segments: int) -> mujoco.MjSpec:
    """Pairs of legs, one behind the other, along a rigid spine."""
    spec = gymnasium_asset("ant.xml")()
    _delete_parts(spec, "front_left_leg", "front_right_leg", "back_leg", "right_back_leg")
    spec.delete(spec.geom("torso_geom"))
    torso = spec.body("torso")
    torso.name = "torso_0"
    for segment in range(n_segments):
        if segment:
            torso = torso.add_body(name=f"torso_{segment}", pos=[-1, 0, 0])
            torso.add_geom(type=_CAPSULE, fromto=[1, 0, 0, 0, 0, 0], size=[0.1, 0, 0], density=100.0)
        for number, leg in enumerate(_OTHER_LEGS if segment else _FRONT_LEGS, start=1):
            # Behind the first pair, legs leave the spine at a right angle.
            _add_leg(torso, f"{number}_{segment}", 0.0 if segment else leg[0], leg)
    _add_motors(spec, [f"{joint}_{segment}" for segment in range(n_segments) for joint in _ANT_JOINTS])
    return spec


def _add_leg(torso: mujoco.MjsBody, name: str, root_x: float, leg: _Leg) -> None:
    x, y, axis, ankle_range = leg
    root = torso.add_body(name=f"leg{name}")
    _add_limb(root, root_x, y)
    thigh = root.add_body(name=f"thigh{name}", pos=[root_x, y, 0])
    thigh.add_joint(name=f"hip{name}", type=_HINGE, axis=[0, 0, 1], range=[-30, 30])
    _add_limb(thigh, x, y)
    shin = thigh.add_body(name=f"shin{name}", pos=[x, y, 0])
    shin.add_joint(name=f"ankle{name}", type=_HINGE, axis=axis, range=ankle_range)
    _add_limb(shin, 2 * x, 2 * y)


def _add_limb(body: mujoco.MjsBody, x: float, y: float) -> None:
    body.add_geom(type=_CAPSULE, fromto=[0, 0, 0, x, y, 0], size=[0.08, 0, 0])


def _delete_parts(spec: mujoco.MjSpec, *bodies: str) -> None:
    """Delete the motors and these bodies."""
    for motor in tuple(spec.actuators):
        spec.delete(motor)
    for body in bodies:
        spec.delete(spec.body(body))


def _add_motors(spec: mujoco.MjSpec, joints: list[str]) -> None:
    for joint in joints:
        spec.add_actuator(
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=joint,
            gear=[_MOTOR_GEAR, 0, 0, 0, 0, 0],
            ctrllimited=_LIMITED,
            ctrlrange=[-1, 1],
        )


def _ant(n_agents: int, per_agent: int) -> MujocoDefinition:
    n = n_agents * per_agent
    segments = [_segment(index, n) for index in range(n)]
    # In MaMuJoCo's graph, a segment neighbours copies of the hips in front of it. The hips themselves do not neighbour
    # the segment.
    copies = [_copy(joint) for joints in segments[:-1] for joint in joints if joint.name.startswith("hip")]
    edges: list[tuple[str, ...]] = []
    for index in range(n):
        hips = (f"hip1_{index}", f"hip2_{index}")
        edges += [*((f"ankle{leg}_{index}", hip) for leg, hip in enumerate(hips, start=1)), hips]
        if index:
            edges.append((f"hip1_{index - 1}'", f"hip2_{index - 1}'", *hips))
    groups = [segments[first : first + per_agent] for first in range(0, n, per_agent)]
    partition = Partition(
        joints=(*(joint for joints in segments for joint in joints), *copies),
        edges=tuple(edges),
        agents=tuple(tuple(joint.name for joints in group for joint in joints) for group in groups),
        shared=ant.SHARED,
        seen_once=frozenset({"contact_forces"}),
    )
    robot = Robot(partial(ant_spec, n), 7 + 4 * n, 6 + 4 * n, ant.PHYSICS_STEP_SECONDS, partition)
    return MujocoDefinition(
        name=f"ManySegmentAnt-{n_agents}x{per_agent}",
        robot=robot,
        mdp=ant.mdp(4 * n, 1 + 7 * n, height_metres=0.75),
        agent_names=_numbered(n_agents),
        instructions=ant.INSTRUCTIONS,
    )


def _segment(index: int, n: int) -> tuple[Joint, ...]:
    """The four joints of a segment, with MaMuJoCo's indices.

    MaMuJoCo counts the last segment's indices from the end of qpos and qvel, and the others' from the start, where the
    torso is. It numbers a segment's motors from its second leg.
    """
    first = 4 * (n - 1 - index)
    qpos, qvel = (first + 3 + 4 * n, first + 2 + 4 * n) if index == n - 1 else (first - 4, first - 4)
    torso = 1 + 7 * index
    bodies = ((0, 1), (1, 2, 3), (0, 4), (4, 5, 6))
    return tuple(
        ant.leg_joint(
            f"{name}_{index}",
            qpos + offset,
            qvel + offset,
            4 * index + (offset + 2) % 4,
            [torso + body for body in bodies[offset]],
        )
        for offset, name in enumerate(_ANT_JOINTS)
    )


def _copy(joint: Joint) -> Joint:
    return Joint(f"{joint.name}'", joint.actuator, joint.own, joint.near)


def _numbered(n_agents: int) -> tuple[str, ...]:
    return tuple(f"part {number}" for number in range(1, n_agents + 1))


_FAMILIES: dict[str, Callable[[int, int], MujocoDefinition]] = {"ManySegmentSwimmer": _swimmer, "ManySegmentAnt": _ant}

#: The listed sizes: those of the paper that introduced these robots (FACMAC), and one agent per segment.
TASKS = (_swimmer(10, 2), _swimmer(6, 1), _ant(2, 3), _ant(3, 1))
