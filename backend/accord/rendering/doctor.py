"""What `accord doctor` asks of a machine that is to make clips."""

import tempfile
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError

from accord.domain.checks import Check
from accord.rendering.errors import RenderingUnavailable
from accord.rendering.probe import probe_backend
from mapt.rendering.encode import CODEC, write_clip
from mapt.rendering.environment import INSTALL
from mapt.rendering.errors import ClipNotWritten
from mapt.rendering.settings import RenderSettings

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
