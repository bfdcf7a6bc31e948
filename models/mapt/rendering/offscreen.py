"""Rendering without a display: OpenGL backends, their environment variables, and child processes that render.

Rendering runs in child processes, because a driver can be missing, crash or hang, and because EGL and CUDA in one
process have hung.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Literal

Backend = Literal["egl", "osmesa"]

#: in order of preference
BACKENDS: tuple[Backend, ...] = ("egl", "osmesa")
INSTALL = "apt-get install -y --no-install-recommends libegl1 libgl1"


def render_environment(backend: Backend) -> dict[str, str]:
    """This process's environment with the variables that must be set before mujoco is imported."""
    return os.environ | {
        "MUJOCO_GL": backend,
        "PYOPENGL_PLATFORM": backend,
        # Mesa renders in the calling thread. One process per core is faster than threads.
        "LP_NUM_THREADS": "0",
    }


def run_rendering_module(
    backend: Backend, module: str, arguments: Sequence[str] = (), *, success_text: str, timeout_seconds: float
) -> str | None:
    """Run a module that renders with this backend in a child process.

    Args:
        success_text: text that the module prints after it has rendered.
        timeout_seconds: time after which the process is killed.

    Returns:
        None if it succeeded, else one line that says why it failed.
    """
    try:
        ended = subprocess.run(
            [sys.executable, "-P", "-m", module, *arguments],
            env=render_environment(backend),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"timed out after {timeout_seconds:g} seconds"
    if success_text in ended.stdout:  # OSMesa can fail at exit after rendering correctly
        return None
    lines = ended.stderr.strip().splitlines()
    return lines[-1] if lines else f"exit status {ended.returncode}"
