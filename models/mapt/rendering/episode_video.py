"""Render an episode to a video in its own process.

`python -m mapt.rendering.episode_video TASK STATES HZ VIDEO`.

Started with the environment that `render_environment` gives. STATES is a safetensors file of `qpos` and `qvel`.
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

#: what is printed when the video is there
DONE = "filmed"
#: a body that comes further than this share of its floor gets a larger one
_SAFE_SHARE = 0.5
#: floor beyond where it comes, metres: more than a camera sees
_BEYOND_METRES = 50.0
#: every so many states are looked at for how far it comes
_STRIDE = 10


def main() -> None:
    """Draw and encode; an error ends with its traceback, whose last line says what it was."""
    task, states, frame_rate_hz, video = sys.argv[1:]
    settings = RenderSettings(frame_rate_hz=float(frame_rate_hz))
    arrays = load_file(states)
    model = load_model(task)
    widen_floors(model, arrays["qpos"])
    with ClipRenderer(model, agent_geoms(task), settings) as renderer:
        write_clip(renderer.frames(arrays["qpos"], arrays["qvel"]), Path(video), settings)
        print(DONE, flush=True)


def widen_floors(model: mujoco.MjModel, qpos: NDArray[np.float64]) -> None:
    """Give the body floor to the end: it runs off a cheetah's 40 metres within one good episode.

    Args:
        model: its planes are changed, in looks alone.
        qpos: (T,nq).
    """
    data = mujoco.MjData(model)
    reach = 0.0
    for state in qpos[::_STRIDE]:
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        reach = max(reach, float(np.abs(data.xpos[:, :2]).max()))
    sizes = model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2]
    # A size of 0 is drawn without end.
    small = (sizes > 0) & (sizes * _SAFE_SHARE < reach)
    model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] = np.where(small, reach + _BEYOND_METRES, sizes)


if __name__ == "__main__":
    main()
