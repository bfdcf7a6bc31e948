"""Frames to an H.264 clip that every browser plays, seeks and steps exactly.

PyAV is called directly: imageio's plugin for it has no way to set crf, preset or `faststart`.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from itertools import count
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, VideoReformatter
from av.video.stream import VideoStream
from numpy.typing import NDArray

from mapt.errors import ClipNotWritten
from mapt.io import atomic_path
from mapt.rendering.settings import RenderSettings

CODEC = "libx264"
PIXEL_FORMAT = "yuv420p"


@dataclass(frozen=True, slots=True)
class ClipFile:
    """A finished H.264 clip in a file."""

    path: Path
    frames: int
    seconds: float
    #: pixels
    width: int
    height: int
    size_bytes: int


def write_clip(frames: Iterable[NDArray[np.uint8]], path: Path, settings: RenderSettings) -> ClipFile:
    """Encode frames as they come. The clip appears at `path` complete, or not at all.

    Args:
        frames: uint8 (H,W,3), RGB, of the settings' size; at least one.
        path: where the clip goes; its folder exists. A clip that is there is replaced.
        settings: size, rate and codec.

    Raises:
        ClipNotWritten: if the frames are of another size or none, or the encoder or the disk refuses.
    """
    written = 0
    with open_clip(path, settings) as add:
        for frame in frames:
            add(frame)
            written += 1
    seconds = written / settings.frame_rate_hz
    return ClipFile(path, written, seconds, settings.width, settings.height, path.stat().st_size)


@contextmanager
def open_clip(path: Path, settings: RenderSettings) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """For whoever has frames of several clips at a time: call what is given with each frame. See `write_clip`."""
    try:
        with atomic_path(path, durable=False) as partial:
            yield from _encode(partial, settings)
    except (FFmpegError, OSError) as error:
        raise ClipNotWritten(f"The clip {path.name} could not be written: {error}") from error


def _encode(path: Path, settings: RenderSettings) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    shape = (settings.height, settings.width, 3)
    # The index goes to the front (`faststart`), so that a browser can play after the first bytes.
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = _open_stream(container.add_stream(CODEC, _rate(settings)), settings)
        reformatter = VideoReformatter()
        numbers = count()

        def add(frame: NDArray[np.uint8]) -> None:
            if frame.shape != shape:
                raise ClipNotWritten(f"A frame is {frame.shape}, but the clip is {shape}.")
            container.mux(stream.encode(_picture(frame, next(numbers), stream, reformatter)))

        yield add
        container.mux(stream.encode())
        written = next(numbers)
    if written == 0:
        raise ClipNotWritten("A clip needs at least one frame.")


def _open_stream(stream: VideoStream, settings: RenderSettings) -> VideoStream:
    stream.width, stream.height, stream.pix_fmt = settings.width, settings.height, PIXEL_FORMAT
    context: VideoCodecContext = stream.codec_context
    context.time_base = 1 / _rate(settings)
    # Short groups of pictures and no B-frames: frame k starts at exactly k/rate, and a seek decodes a handful.
    context.gop_size = settings.codec.keyframe_interval_frames
    context.max_b_frames = 0
    # Rendering runs one process a core, so that threads inside the encoder would only contend.
    context.thread_count = 1
    # Browsers guess the matrix of an untagged video by its size; tagged, the colours are the legend's.
    context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
    context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
    context.options = {"preset": settings.codec.preset, "crf": str(settings.codec.crf)}
    return stream


def _picture(
    frame: NDArray[np.uint8], number: int, stream: VideoStream, reformatter: VideoReformatter
) -> av.VideoFrame:
    picture = reformatter.reformat(
        av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24"),
        format=PIXEL_FORMAT,
        dst_colorspace=Colorspace.ITU709,
        dst_color_range=ColorRange.MPEG,
        threads=1,
    )
    picture.pts, picture.time_base = number, stream.codec_context.time_base
    return picture


def _rate(settings: RenderSettings) -> Fraction:
    return Fraction(settings.frame_rate_hz).limit_denominator(1001)
