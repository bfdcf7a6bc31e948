"""Drawing in a process of its own: a driver may be missing, broken or hang, and EGL and CUDA in one have hung."""

import subprocess
import sys
from collections.abc import Sequence

from mapt.rendering.environment import Backend, render_environment


def draw_apart(
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
