"""Reacher with one agent per joint: gymnasium's Reacher-v5 with MaMuJoCo's partition."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np

from mapt.tasks.mujoco_definition import Features, FloatArray, MujocoMdp, Robot, gymnasium_asset, sum_of_squares
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.partition import Joint, Partition, columns

ANGLE_NOISE = 0.1
SPEED_NOISE = 0.005
TARGET_RADIUS_METRES = 0.2
#: Two angles of the arm and the target's x and y.
NQ = NV = 4
FINGERTIP, TARGET = 3, 4


def make_spec() -> mujoco.MjSpec:
    """Gymnasium's reacher. Its pink border gets MuJoCo's default colour, in which clips show surroundings."""
    spec = gymnasium_asset("reacher.xml")()
    for geom in spec.worldbody.geoms:
        if geom.type != mujoco.mjtGeom.mjGEOM_PLANE:
            geom.rgba = [0.5, 0.5, 0.5, 1.0]
    return spec


def sample_start(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    """The arm nearly straight and at rest, the target anywhere within reach."""
    qpos = rng.uniform(-ANGLE_NOISE, ANGLE_NOISE, size=(n, NQ))
    qpos[:, 2:] = _targets(rng, n)
    qvel = rng.uniform(-SPEED_NOISE, SPEED_NOISE, size=(n, NV))
    qvel[:, 2:] = 0.0
    return qpos, qvel


def _targets(rng: np.random.Generator, n: int) -> FloatArray:
    """(n, 2): uniform on a disc, by rejection sampling from the square around it."""
    targets = np.full((n, 2), np.inf)
    while (outside := np.flatnonzero(np.linalg.norm(targets, axis=1) >= TARGET_RADIUS_METRES)).size:
        targets[outside] = rng.uniform(-TARGET_RADIUS_METRES, TARGET_RADIUS_METRES, size=(outside.size, 2))
    return targets


def compute_features(features: Features) -> None:
    """Sines and cosines of the arm's angles, and the vector from the target to the fingertip."""
    angles = features["qpos"][:, :2]
    np.sin(angles, out=features["sine"])
    np.cos(angles, out=features["cosine"])
    np.subtract(features["xpos"][:, FINGERTIP], features["xpos"][:, TARGET], out=features["offset"])


def reward(_before: Features, after: Features, controls: FloatArray) -> FloatArray:
    """Minus the fingertip's distance from the target in metres, minus the squared controls."""
    return -np.linalg.norm(after["offset"], axis=1) - sum_of_squares(controls)


_SHOULDER = Joint("joint0", 0, own=(("sine", 0), ("cosine", 0), ("qvel", 0)), near=(("sine", 0), ("cosine", 0)))
_ELBOW = Joint(
    "joint1",
    1,
    own=(("sine", 1), ("cosine", 1), ("qvel", 1), *columns("offset", 0, 3)),
    near=(("sine", 1), ("cosine", 1)),
)
_PARTITION = Partition(
    joints=(_SHOULDER, _ELBOW),
    edges=(("joint0", "joint1"),),
    agents=(("joint0",), ("joint1",)),
    shared=columns("qpos", 2, 4),
)

TASKS = (
    MujocoDefinition(
        name="Reacher-2x1",
        robot=Robot(make_spec, NQ, NV, 0.01, _PARTITION),
        mdp=MujocoMdp(
            frame_skip=2,
            sample_start=sample_start,
            reward=reward,
            previous=(),
            fields={"xpos": (5, 3)},
            features={"sine": (2,), "cosine": (2,), "offset": (3,)},
            compute=compute_features,
            state=columns("cosine", 0, 2)
            + columns("sine", 0, 2)
            + columns("qpos", 2, 4)
            + columns("qvel", 0, 2)
            + columns("offset", 0, 2),
        ),
        agent_names=("upper arm", "lower arm"),
        instructions="The arm should bring its tip to the target quickly, without swinging past it, and hold it there.",
        horizon_steps=50,
    ),
)
