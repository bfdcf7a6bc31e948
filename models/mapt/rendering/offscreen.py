"""What a process that draws without a display must find in its environment."""

import os
import subprocess
import sys
from collections.abc import Sequence
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


def run_rendering_module(
    backend: Backend, module: str, arguments: Sequence[str] = (), *, done: str, limit_seconds: float, undone: str
) -> str | None:
    """Run a module that draws with this backend.

    Args:
        done: what it prints once it has drawn.
        limit_seconds: how long it may take.
        undone: what it has not done if it takes longer, as in "no frame".

    Returns:
        None if it drew, else what went wrong, in a line.
    """
    try:
        ended = subprocess.run(
            [sys.executable, "-P", "-m", module, *arguments],
            env=render_environment(backend),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=limit_seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"{undone} in {limit_seconds:g} seconds"
    if done in ended.stdout:  # OSMesa draws well and then fails at its exit
        return None
    lines = ended.stderr.strip().splitlines()
    return lines[-1] if lines else f"exit status {ended.returncode}"
