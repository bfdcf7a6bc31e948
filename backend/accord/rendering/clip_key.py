"""The name of a clip: a key made from everything that goes into it."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.rendering.settings import RenderSettings

#: raise it when the same inputs give other frames: a change of colours, camera, scene or encoder
RENDERER_VERSION = 2


def clip_key(
    qpos: NDArray[np.float64],
    qvel: NDArray[np.float64],
    model: mujoco.MjModel,
    agent_geoms: Sequence[Sequence[int]],
    settings: RenderSettings,
) -> str:
    """The name under which a clip is kept: equal inputs, equal key.

    It is made from what goes in, since an encoder's bytes may differ from run to run.

    Args:
        qpos, qvel: simulator states, float64 (T,nq) and (T,nv).
        model: the task's model as it is simulated.
        agent_geoms: ids of the geoms that each of the N agents moves.
        settings: the look, the camera and the codec.

    Returns:
        64 hexadecimal digits (SHA-256).
    """
    digest = hashlib.sha256(model_bytes(model))
    look = {
        "renderer": RENDERER_VERSION,
        "mujoco": mujoco.__version__,
        "agents": [[int(geom) for geom in geoms] for geoms in agent_geoms],
        "settings": asdict(settings),
        "shapes": [qpos.shape, qvel.shape],
    }
    digest.update(json.dumps(look, sort_keys=True).encode())
    for states in (qpos, qvel):
        digest.update(np.ascontiguousarray(states, dtype="<f8").tobytes())
    return digest.hexdigest()


def model_bytes(model: mujoco.MjModel) -> bytes:
    """The compiled model as MuJoCo saves it (MJB): every number of it."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()
