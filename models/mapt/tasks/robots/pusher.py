"""Pusher with one agent each for shoulder, elbow and wrist: gymnasium's Pusher-v5 with MaMuJoCo's partition."""

from itertools import pairwise

import numpy as np

from mapt.tasks.mujoco_definition import Features, FloatArray, MujocoMdp, Robot, gymnasium_asset, sum_of_squares
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.partition import Joint, Partition, columns, hinge

NEAR_WEIGHT = 0.5
CONTROL_COST_WEIGHT = 0.1
SPEED_NOISE = 0.005
#: The object starts in this rectangle, in metres relative to the goal, and at least this far from the goal.
OBJECT_LOW, OBJECT_HIGH = (-0.3, -0.2), (0.0, 0.2)
OBJECT_CLEARANCE_METRES = 0.17
#: Seven joints of the arm, the object's two slides and the goal's two.
NQ = NV = 11
N_ARM = 7
N_BODIES = 13
TIP, OBJECT, GOAL = 10, 11, 12


def sample_start(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    """The arm at zero and nearly at rest, the object anywhere but near the goal."""
    qpos = np.zeros((n, NQ))
    qpos[:, 7:9] = _objects(rng, n)
    qvel = rng.uniform(-SPEED_NOISE, SPEED_NOISE, size=(n, NV))
    qvel[:, N_ARM:] = 0.0
    return qpos, qvel


def _objects(rng: np.random.Generator, n: int) -> FloatArray:
    """(n, 2): uniform on the rectangle, by rejection sampling."""
    positions = np.zeros((n, 2))
    while (near := np.flatnonzero(np.linalg.norm(positions, axis=1) <= OBJECT_CLEARANCE_METRES)).size:
        positions[near] = rng.uniform(OBJECT_LOW, OBJECT_HIGH, size=(near.size, 2))
    return positions


def reward(_before: Features, after: Features, controls: FloatArray) -> FloatArray:
    """Minus the object's distance from the goal and half that from the tip in metres, minus the control cost."""
    positions = after["xpos"]
    to_goal = np.linalg.norm(positions[:, OBJECT] - positions[:, GOAL], axis=1)
    to_tip = np.linalg.norm(positions[:, OBJECT] - positions[:, TIP], axis=1)
    return -to_goal - NEAR_WEIGHT * to_tip - CONTROL_COST_WEIGHT * sum_of_squares(controls)


SHOULDER = ("r_shoulder_pan_joint", "r_shoulder_lift_joint", "r_upper_arm_roll_joint")
ELBOW = ("r_elbow_flex_joint",)
WRIST = ("r_forearm_roll_joint", "r_wrist_flex_joint", "r_wrist_roll_joint")
_CHAIN = (*SHOULDER, *ELBOW, *WRIST)
#: MaMuJoCo gives the first two joints the label of the last, and their order varies; here it is the arm's order.
_LABELS: dict[str, str] = dict.fromkeys(SHOULDER[:2], WRIST[-1])


def _joint(name: str, index: int) -> Joint:
    joint = hinge(name, index, index, actuator=index)
    return Joint(name, index, joint.own, joint.near, _LABELS.get(name, ""))


_TARGETS = columns("xpos", 3 * TIP, 3 * (GOAL + 1))
_PARTITION = Partition(
    joints=tuple(_joint(name, index) for index, name in enumerate(_CHAIN)),
    edges=tuple(pairwise(_CHAIN)),
    agents=(SHOULDER, ELBOW, WRIST),
    shared=_TARGETS,
)

TASKS = (
    MujocoDefinition(
        name="Pusher-3p",
        robot=Robot(gymnasium_asset("pusher_v5.xml"), NQ, NV, 0.01, _PARTITION),
        mdp=MujocoMdp(
            frame_skip=5,
            sample_start=sample_start,
            reward=reward,
            previous=(),
            fields={"xpos": (N_BODIES, 3)},
            state=columns("qpos", 0, N_ARM) + columns("qvel", 0, N_ARM) + _TARGETS,
        ),
        agent_names=("shoulder", "elbow", "wrist"),
        instructions="The arm should push the object onto the goal, gently, and leave it there.",
        horizon_steps=100,
        action_limit=2.0,
    ),
)
