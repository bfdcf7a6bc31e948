"""Which OpenGL can draw here without a display.

A driver may be missing, broken or hang, so each is tried in a child process that draws one frame.
"""

from accord.rendering.errors import RenderingUnavailable
from mapt.rendering.apart import draw_apart
from mapt.rendering.environment import BACKENDS, INSTALL, Backend

#: what the child prints when its frame shows what it should
DREW = "drew a frame"
#: the first frame takes 1 to 2 s; a busy machine may need ten times that
PROBE_LIMIT_SECONDS = 60.0


def probe_backend(limit_seconds: float = PROBE_LIMIT_SECONDS) -> Backend:
    """The first of EGL and OSMesa that draws a frame.

    Args:
        limit_seconds: how long each may take.

    Raises:
        RenderingUnavailable: if neither does; the message says what each said and what to install.
    """
    said: list[str] = []
    for backend in BACKENDS:
        failure = try_backend(backend, limit_seconds)
        if failure is None:
            return backend
        said.append(f"{backend}: {failure}")
    raise RenderingUnavailable(
        f"No clip can be drawn: no OpenGL works here without a display ({'; '.join(said)}). Install one: {INSTALL}"
    )


def try_backend(backend: Backend, limit_seconds: float) -> str | None:
    """Draw one frame with this backend in a child process. None if it did, else what went wrong, in a line."""
    return draw_apart(
        backend, "accord.rendering.probe_child", done=DREW, limit_seconds=limit_seconds, undone="no frame"
    )
