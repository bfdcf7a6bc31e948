"""Still images of clips, for lists of clips."""

import imageio.v3 as iio
import numpy as np
from av.error import FFmpegError

from mapt.errors import ClipNotRead

#: pixels, at least; a clip's width is divided by a whole number
THUMBNAIL_WIDTH = 144
_JPEG_QUALITY = 80


def thumbnail(video: bytes, frame: int) -> bytes:
    """One frame of a clip as a small JPEG image.

    Args:
        video: a complete MP4 file.
        frame: index of the frame.

    Raises:
        ClipNotRead: if the file is not a video or has no such frame.
    """
    try:
        image = iio.imread(video, plugin="pyav", index=frame)
    except (OSError, FFmpegError) as error:
        raise ClipNotRead(str(error)) from error
    step = max(1, image.shape[1] // THUMBNAIL_WIDTH)
    height, width = (size // step * step for size in image.shape[:2])
    # The mean of step x step pixels: a thin limb does not break up, as it would if pixels were skipped.
    blocks = image[:height, :width].reshape(height // step, step, width // step, step, 3)
    return iio.imwrite("<bytes>", blocks.mean(axis=(1, 3)).astype(np.uint8), extension=".jpg", quality=_JPEG_QUALITY)
