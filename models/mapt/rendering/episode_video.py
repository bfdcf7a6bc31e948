"""Render an episode to a video in its own process.

`python -m mapt.rendering.episode_video TASK STATES HZ VIDEO`.

Needs the environment of `render_environment`. STATES is a safetensors file of `qpos` (T, nq) and `qvel` (T, nv).
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import sys
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file

from mapt.rendering.encode import write_clip
from mapt.rendering.renderer import ClipRenderer
from mapt.rendering.settings import RenderSettings
from mapt.tasks import agent_geoms, load_model

#: printed when the video is complete
SUCCESS = "rendered the episode"
#: a floor is enlarged if the body reaches further than this share of it
_MAX_REACH_SHARE = 0.5
#: floor in metres beyond the body's reach, more than the camera sees
_MARGIN_METRES = 50.0
#: the reach is computed from one state of this many
_STRIDE = 10


def main() -> None:
    """Render and encode the video. On an error, the process ends with a traceback."""
    task, states, frame_rate_hz, video = sys.argv[1:]
    settings = RenderSettings(frame_rate_hz=float(frame_rate_hz))
    arrays = load_file(states)
    model = load_model(task)
    widen_floors(model, arrays["qpos"])
    with ClipRenderer(model, agent_geoms(task), settings) as renderer:
        write_clip(renderer.frames(arrays["qpos"], arrays["qvel"]), Path(video), settings)
        print(SUCCESS, flush=True)


def widen_floors(model: mujoco.MjModel, qpos: NDArray[np.float64]) -> None:
    """Enlarge the floors to the body's reach. A fast cheetah leaves its floor of 40 metres within one episode.

    Args:
        model: the visible size of its planes is changed; physics treats planes as infinite.
        qpos: (T, nq).
    """
    data = mujoco.MjData(model)
    reach = 0.0
    for state in qpos[::_STRIDE]:
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        reach = max(reach, float(np.abs(data.xpos[:, :2]).max()))
    sizes = model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2]
    # A size of 0 is rendered as infinite.
    small = (sizes > 0) & (sizes * _MAX_REACH_SHARE < reach)
    model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] = np.where(small, reach + _MARGIN_METRES, sizes)


if __name__ == "__main__":
    main()
