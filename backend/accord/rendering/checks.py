"""Which OpenGL can draw here without a display.

A driver may be missing, broken or hang, so each is tried in a child process that draws one frame.
"""

import tempfile
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError

from accord.domain.checks import Check
from accord.rendering.process import RenderingUnavailable
from mapt.errors import ClipNotWritten
from mapt.rendering.encode import CODEC, write_clip
from mapt.rendering.offscreen import BACKENDS, INSTALL, Backend, run_rendering_module
from mapt.rendering.settings import RenderSettings

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
    return run_rendering_module(
        backend, "accord.rendering.child", ["probe"], done=DREW, limit_seconds=limit_seconds, undone="no frame"
    )


FRAMES = 5


def check_rendering() -> Check:
    """Whether a frame can be drawn without a display, and by what. Takes 1 to 2 s."""
    name = "OpenGL without a display"
    try:
        backend = probe_backend()
    except RenderingUnavailable as error:
        return Check(name, ok=False, detail=str(error), fix=INSTALL)
    return Check(name, ok=True, detail=f"{backend} drew a frame")


def check_encoder() -> Check:
    """Whether a clip can be encoded and decoded again: five frames, for real."""
    name = "H.264 encoder"
    settings = RenderSettings(width=64, height=48)
    shades = np.linspace(0, 255, FRAMES).astype(np.uint8)
    frames = [np.full((settings.height, settings.width, 3), shade, np.uint8) for shade in shades]
    reinstall = f"pip install --force-reinstall av=={av.__version__}"
    with tempfile.TemporaryDirectory() as folder:
        try:
            clip = write_clip(frames, Path(folder) / "check.mp4", settings)
            with av.open(str(clip.path)) as container:
                decoded = sum(1 for _ in container.decode(video=0))
        except (ClipNotWritten, FFmpegError) as error:
            return Check(name, ok=False, detail=str(error), fix=reinstall)
    if decoded != FRAMES:
        return Check(name, ok=False, detail=f"{FRAMES} frames in, {decoded} out", fix=reinstall)
    return Check(name, ok=True, detail=f"PyAV {av.__version__}, {CODEC}: {FRAMES} frames in and out")
