"""Two half cheetahs joined by an elastic tendon, with one agent per cheetah: gymnasium-robotics' CoupledHalfCheetah.

The model is assembled from gymnasium's half_cheetah.xml.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np

from mapt.tasks.mujoco_definition import (
    Features,
    FloatArray,
    MujocoMdp,
    Robot,
    gymnasium_asset,
    sum_of_squares,
    uniform_start,
)
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.partition import Joint, Partition, columns, hinge
from mapt.tasks.robots import half_cheetah

CHEETAHS = ("first", "second")
SIDES_METRES = (-1.0, 1.0)
TENDON_RANGE_METRES = (1.5, 3.5)
TENDON_STIFFNESS = 0.1
#: nine per cheetah
NQ = NV = 18
SECOND = 9


def make_spec() -> mujoco.MjSpec:
    """Two cheetahs, whose parts are prefixed first_ and second_, with a tendon between their torsos."""
    read = gymnasium_asset("half_cheetah.xml")
    spec = read()
    spec.modelname = "coupled_cheetah"
    for motor in tuple(spec.actuators):
        spec.delete(motor)
    spec.delete(spec.body("torso"))
    for name, side in zip(CHEETAHS, SIDES_METRES, strict=True):
        torso = read().body("torso")
        torso.add_site(name="knot", size=[0.1, 0.0, 0.0])
        spec.worldbody.add_frame(pos=[0.0, side, 0.0]).attach_body(torso, f"{name}_", "")
    tendon = spec.add_tendon(
        name="tendon0",
        width=0.05,
        rgba=[0.95, 0.3, 0.3, 1.0],
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=list(TENDON_RANGE_METRES),
        stiffness=[TENDON_STIFFNESS, 0.0, 0.0],
    )
    for name in CHEETAHS:
        tendon.wrap_site(f"{name}_knot")
    return spec


def reward(before: Features, after: Features, controls: FloatArray) -> FloatArray:
    """Mean over the cheetahs of forward speed minus the control cost."""
    distance = after["qpos"][:, (0, SECOND)] - before["qpos"][:, (0, SECOND)]
    speed = (distance / half_cheetah.STEP_SECONDS).mean(axis=1)
    return speed - half_cheetah.CONTROL_COST_WEIGHT * sum_of_squares(controls) / 2.0


#: The tendon has a moment about each of the three root joints of each cheetah; agents observe those about x and z.
_TENDON = (
    ("ten_J", 0),
    ("ten_J", 1),
    ("ten_J", 3),
    ("ten_J", 4),
    ("ten_length", 0),
    ("ten_velocity", 0),
)


def _joints(number: int, cheetah: str) -> tuple[Joint, ...]:
    """A cheetah's joints. As in MaMuJoCo, both agents observe the second cheetah's angles."""
    names = [f"{cheetah}_{joint.name}" for joint in half_cheetah.JOINTS]
    first, *rest = (hinge(name, 12 + i, 12 + i, actuator=6 * number + i) for i, name in enumerate(names))
    return Joint(first.name, first.actuator, (*first.own, *_TENDON), first.near), *rest


_TEAM = tuple(_joints(number, cheetah) for number, cheetah in enumerate(CHEETAHS))
_PARTITION = Partition(
    joints=(*_TEAM[0], *_TEAM[1]),
    edges=tuple((f"{name}_{one}", f"{name}_{other}") for name in CHEETAHS for one, other in half_cheetah.EDGES),
    agents=tuple(tuple(joint.name for joint in joints) for joints in _TEAM),
    shared=(
        *(("qpos", index) for index in (2, 1, SECOND + 2, SECOND + 1)),
        *(("qvel", index) for index in (0, 2, 1, SECOND, SECOND + 2, SECOND + 1)),
    ),
)

TASKS = (
    MujocoDefinition(
        name="CoupledHalfCheetah-1p1",
        robot=Robot(make_spec, NQ, NV, half_cheetah.PHYSICS_STEP_SECONDS, _PARTITION, total_mass_kg=14.0),
        mdp=MujocoMdp(
            frame_skip=half_cheetah.FRAME_SKIP,
            sample_start=uniform_start(np.zeros(NQ), NV, 0.1, normal_velocities=True),
            reward=reward,
            fields={"ten_J": (6,), "ten_length": (1,), "ten_velocity": (1,)},
            state=columns("qpos", 1, SECOND) + columns("qpos", SECOND + 1, NQ) + columns("qvel", 0, NV) + _TENDON,
        ),
        agent_names=("near cheetah", "far cheetah"),
        instructions="Two cheetahs are tied together. Both should run to the right as fast as they can, at one pace.",
    ),
)
