"""Checks that this machine can render without a display and encode clips."""

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

#: printed by the child process if its frame shows the expected colour
PROBE_SUCCESS = "rendered a frame"
#: the first frame takes 1 to 2 s, on a busy machine perhaps ten times as long
PROBE_TIMEOUT_SECONDS = 60.0


def probe_backend(timeout_seconds: float = PROBE_TIMEOUT_SECONDS) -> Backend:
    """The first of EGL and OSMesa that renders a frame.

    Args:
        timeout_seconds: for each backend.

    Raises:
        RenderingUnavailable: if neither does. The message gives both errors and says what to install.
    """
    failures: list[str] = []
    for backend in BACKENDS:
        failure = try_backend(backend, timeout_seconds)
        if failure is None:
            return backend
        failures.append(f"{backend}: {failure}")
    raise RenderingUnavailable(f"OpenGL does not render without a display here ({'; '.join(failures)}).", INSTALL)


def try_backend(backend: Backend, timeout_seconds: float) -> str | None:
    """Render one frame with this backend in a child process. Returns None, or one line that says why it failed."""
    return run_rendering_module(
        backend, "accord.rendering.child", ["probe"], success_text=PROBE_SUCCESS, timeout_seconds=timeout_seconds
    )


#: frames of the encoder's check
FRAMES = 5


def check_rendering() -> Check:
    """Check that a frame can be rendered without a display, and with which backend. Takes 1 to 2 s."""
    name = "OpenGL without a display"
    try:
        backend = probe_backend()
    except RenderingUnavailable as error:
        return Check(name, ok=False, detail=error.reason, fix=INSTALL)
    return Check(name, ok=True, detail=f"{backend} rendered a frame")


def check_encoder() -> Check:
    """Check that a clip of five frames can be encoded and decoded."""
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
        return Check(name, ok=False, detail=f"encoded {FRAMES} frames, decoded {decoded}", fix=reinstall)
    return Check(name, ok=True, detail=f"PyAV {av.__version__}, {CODEC}: encoded and decoded {FRAMES} frames")
