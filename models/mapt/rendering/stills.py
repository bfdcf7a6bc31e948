"""Still images of clips, for lists of clips, and animations, for pages and messages that play no video."""

import io
import math

import av
import imageio.v3 as iio
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import Interpolation
from numpy.typing import NDArray

from mapt.errors import ClipNotRead

#: pixels; an animation is several times as large as its video
ANIMATION_WIDTH = 320
#: browsers play faster GIFs at 10 frames per second
MAX_ANIMATION_HZ = 50.0
#: pixels
THUMBNAIL_WIDTH = 160
_JPEG_QUALITY = 80


def thumbnail(video: bytes) -> bytes:
    """The last key frame before the middle of a clip, as a small JPEG image.

    Decoding one key frame and scaling it in the decoder takes 3 ms; reading the middle frame with imageio takes 60 ms.

    Args:
        video: a complete MP4 file.

    Raises:
        ClipNotRead: if the file is not a video or is damaged.
    """
    try:
        with av.open(io.BytesIO(video), "r") as container:
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1
            container.seek((stream.duration or 0) // 2, stream=stream)
            frame = next(container.decode(stream))
    except (FFmpegError, IndexError, StopIteration) as error:
        raise ClipNotRead(str(error)) from error
    height = round(frame.height * THUMBNAIL_WIDTH / frame.width)
    # Averaging keeps thin limbs whole, which skipping pixels would not.
    image = frame.to_ndarray(format="rgb24", width=THUMBNAIL_WIDTH, height=height, interpolation=Interpolation.AREA)
    return iio.imwrite("<bytes>", image, extension=".jpg", quality=_JPEG_QUALITY)


def animation(video: bytes) -> bytes:
    """A clip as a GIF that repeats for ever, at most `MAX_ANIMATION_HZ` frames per second.

    Args:
        video: a complete MP4 file.

    Raises:
        ClipNotRead: if the file is not a video or is damaged.
    """
    try:
        with av.open(io.BytesIO(video), "r") as container:
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1
            rate = float(stream.average_rate or 1)
            every = math.ceil(rate / MAX_ANIMATION_HZ)
            frames = [_scaled(frame) for number, frame in enumerate(container.decode(stream)) if number % every == 0]
    except (FFmpegError, IndexError) as error:
        raise ClipNotRead(str(error)) from error
    if not frames:
        raise ClipNotRead("The clip has no frames.")
    return iio.imwrite("<bytes>", frames, extension=".gif", duration=1000 * every / rate, loop=0)


def _scaled(frame: av.VideoFrame) -> NDArray[np.uint8]:
    height = round(frame.height * ANIMATION_WIDTH / frame.width)
    scaled = frame.to_ndarray(format="rgb24", width=ANIMATION_WIDTH, height=height, interpolation=Interpolation.AREA)
    return scaled.astype(np.uint8, copy=False)
