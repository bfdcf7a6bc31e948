"""HalfCheetah run by a team: six agents of one joint each, or a back leg and a front leg.

Physics, reward and starts are gymnasium's HalfCheetah-v5; the partition is gymnasium-robotics' MaMuJoCo's.
"""

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.mujoco_task import Float64s, MujocoRules
from mapt.tasks.partition import Joint, Partition
from mapt.tasks.scene import MujocoScene

FRAME_SKIP = 5
PHYSICS_STEP_SECONDS = 0.01
STEP_SECONDS = FRAME_SKIP * PHYSICS_STEP_SECONDS
HORIZON_STEPS = 1000
CONTROL_COST_WEIGHT = 0.1
RESET_NOISE_SCALE = 0.1
#: Root x, root z, pitch and six joints.
NQ = NV = 9

JOINTS = tuple(
    Joint(name, qpos=3 + index, qvel=3 + index, actuator=index)
    for index, name in enumerate(("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"))
)
EDGES = (("bfoot", "bshin"), ("bshin", "bthigh"), ("bthigh", "fthigh"), ("fthigh", "fshin"), ("fshin", "ffoot"))
INSTRUCTIONS = (
    "The cheetah should run forwards, to the right, as fast as it can. "
    "Smooth strides on its feet are better than flailing or sliding on its back."
)


def scene(agents: tuple[tuple[str, ...], ...]) -> MujocoScene:
    """The cheetah with its joints shared out among `agents`. Nobody sees how far it has run (root x)."""
    partition = Partition(JOINTS, EDGES, agents, shared_qpos=(1, 2), shared_qvel=(0, 1, 2))
    return MujocoScene(asset="half_cheetah.xml", total_mass_kg=14.0, partition=partition)


ONE_JOINT_EACH = scene(tuple((joint.name,) for joint in JOINTS))
ONE_LEG_EACH = scene((("bthigh", "bshin", "bfoot"), ("fthigh", "fshin", "ffoot")))


def draw_start(rng: np.random.Generator, n: int) -> tuple[Float64s, Float64s]:
    """qpos (n, 9) and qvel (n, 9): the model's rest pose, all zeros, with uniform and normal noise."""
    qpos = rng.uniform(-RESET_NOISE_SCALE, RESET_NOISE_SCALE, size=(n, NQ))
    return qpos, RESET_NOISE_SCALE * rng.standard_normal((n, NV))


def reward(qpos_before: Float64s, qpos_after: Float64s, controls: Float64s) -> Float64s:
    """Forward speed in metres per second less the cost of the controls as given, before MuJoCo clamps them."""
    speed = (qpos_after[:, 0] - qpos_before[:, 0]) / STEP_SECONDS
    return speed - CONTROL_COST_WEIGHT * np.square(controls).sum(axis=1)


def never_terminated(qpos: Float64s, _qvel: Float64s) -> NDArray[np.bool_]:
    return np.zeros(len(qpos), dtype=bool)


RULES = MujocoRules(
    frame_skip=FRAME_SKIP,
    draw_start=draw_start,
    reward=reward,
    terminated=never_terminated,
    state_columns=slice(1, NQ + NV),
)
