"""Reads the images on the page's canvases and compares them with the frames of the clips' files."""

from base64 import b64decode

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
from playwright.sync_api import Page

_IMAGE = "side => document.querySelector(`[data-testid=clip-${side}]`).toDataURL('image/png')"


def reference_frames(page: Page, side: str) -> list[npt.NDArray[np.uint8]]:
    """The frames of the clip on one side, decoded by FFmpeg: RGB (H,W,3)."""
    url = page.evaluate(
        "side => new URL(document.querySelector(`[data-testid=clip-${side}]`).dataset.clip, origin).href", side
    )
    return list(iio.imread(page.request.get(url).body(), plugin="pyav"))


def image(page: Page, side: str) -> npt.NDArray[np.uint8]:
    """The image on the canvas of one side: RGB (H,W,3)."""
    _, _, png = page.evaluate(_IMAGE, side).partition(",")
    return iio.imread(b64decode(png), extension=".png")[..., :3]


def assert_shows(shown: npt.NDArray[np.uint8], frames: list[npt.NDArray[np.uint8]], index: int) -> None:
    """The image `shown` is closest to the frame with this index. Two decoders may differ by a few grey levels."""
    distances = [float(np.abs(shown.astype(int) - frame.astype(int)).mean()) for frame in frames]
    assert int(np.argmin(distances)) == index, distances
    assert distances[index] < 4.0, distances
