"""The content key of a clip: a hash of everything that determines its frames."""

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

#: increase it when equal inputs give different frames: a change of colours, camera, scene or encoder
RENDERER_VERSION = 7


def clip_key(
    qpos: NDArray[np.float64],
    qvel: NDArray[np.float64],
    model: mujoco.MjModel,
    agent_geoms: Sequence[Sequence[int]],
    settings: RenderSettings,
) -> str:
    """Hash the inputs of a clip. Equal inputs give equal keys.

    The key does not depend on the encoded bytes, which can differ between runs.

    Args:
        qpos, qvel: simulator states, float64 (T, nq) and (T, nv).
        model: the task's model.
        agent_geoms: ids of the geoms that each of the N agents moves.
        settings: size, frame rate, quality, camera and codec.

    Returns:
        64 hexadecimal digits (SHA-256).
    """
    inputs = {
        "renderer": RENDERER_VERSION,
        "mujoco": mujoco.__version__,
        "agents": [[int(geom) for geom in geoms] for geoms in agent_geoms],
        "settings": asdict(settings),
        "shapes": [qpos.shape, qvel.shape],
    }
    return _key(model_bytes(model), inputs, (qpos, qvel))


def drawn_clip_key(qpos: NDArray[np.float64], task_name: str, version: int, settings: RenderSettings) -> str:
    """As `clip_key`, for a task that has a drawing.

    Args:
        qpos: drawn states, float64 (T, nq).
        version: of the drawing.
    """
    inputs = {"task": task_name, "version": version, "settings": asdict(settings), "shapes": [qpos.shape]}
    return _key(b"", inputs, (qpos,))


def _key(model: bytes, inputs: dict[str, object], states: Sequence[NDArray[np.float64]]) -> str:
    digest = hashlib.sha256(model)
    digest.update(json.dumps(inputs, sort_keys=True).encode())
    for each in states:
        digest.update(np.ascontiguousarray(each, dtype="<f8").tobytes())
    return digest.hexdigest()


def model_bytes(model: mujoco.MjModel) -> bytes:
    """The compiled model in MuJoCo's binary format (MJB), which contains all of its numbers."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()
