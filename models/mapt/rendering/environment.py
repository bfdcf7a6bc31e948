"""What a process that draws without a display must find in its environment."""

import os
from typing import Literal

Backend = Literal["egl", "osmesa"]

#: in the order of preference
BACKENDS: tuple[Backend, ...] = ("egl", "osmesa")
INSTALL = "apt-get install -y --no-install-recommends libegl1 libgl1"


def render_environment(backend: Backend) -> dict[str, str]:
    """The environment for a process that draws: this process's, with what must be set before mujoco's import."""
    return os.environ | {
        "MUJOCO_GL": backend,
        "PYOPENGL_PLATFORM": backend,
        # Mesa's rasteriser draws in the calling thread: one process a core is faster than threads.
        "LP_NUM_THREADS": "0",
    }
