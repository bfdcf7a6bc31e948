"""Where the camera looks, frame by frame.

A labeller judges the gait by the body against the frame, and the speed by the floor that passes. So the camera
keeps one height, one distance and one direction for all clips of a task (see `mapt.rendering.framing`), and goes along
smoothly instead of copying every jolt of the body. Only where the body would leave the view does it give way: it leans
after the body.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: half of the window over which the body's path is smoothed
SMOOTHING_SECONDS = 0.4
#: part of the view's half that the body may fill
SAFE_SHARE = 0.94


@dataclass(frozen=True, slots=True)
class View:
    """What the camera sees at the distance of the body, metres from the middle to an edge."""

    half_width: float
    half_height: float


def camera_path(
    lowest: NDArray[np.float64],
    highest: NDArray[np.float64],
    wished: NDArray[np.float64],
    view: View,
    window: int,
) -> NDArray[np.float64]:
    """The points the camera looks at.

    Args:
        lowest, highest: corners of the body's bounding box in the picture's plane, metres (T,2): right, up.
        wished: (T,2), a smooth path that it takes as long as the body fits.
        view: what is seen.
        window: frames on each side over which giving way is smoothed.

    Returns:
        (T,2) float64: right, up. The bounding box is within the view in every frame, if it fits at all.
    """
    half = np.array([view.half_width, view.half_height]) * SAFE_SHARE
    middle = (lowest + highest) / 2
    # Too far from the wish on one side or the other: how much the camera must give way, made smooth without
    # becoming less than is needed.
    ahead = envelope(np.maximum(highest - half - wished, 0.0), window)
    behind = envelope(np.maximum(wished - (lowest + half), 0.0), window)
    led = wished + ahead - behind
    # Where both gave way at once neither is exact, and a body larger than the view has no room: its middle wins.
    least, most = highest - half, lowest + half
    return np.where(least > most, middle, np.clip(led, np.minimum(least, most), np.maximum(least, most)))


def smooth(path: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Moving average (T,) with mirrored ends, so that steady motion stays steady to the last frame."""
    padded = np.pad(path, window, mode="reflect", reflect_type="odd") if len(path) > 1 else path
    if len(path) == 1 or window == 0:
        return path.copy()
    kernel = np.full(2 * window + 1, 1 / (2 * window + 1))
    return np.convolve(padded, kernel, mode="valid")


def envelope(need: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """A smooth curve (T,2) nowhere below `need`: the running maximum, then the moving average of it."""
    if window == 0 or not need.any():
        return need
    padded = np.pad(need, ((2 * window, 2 * window), (0, 0)), mode="edge")
    raised = np.lib.stride_tricks.sliding_window_view(padded, 2 * window + 1, axis=0).max(axis=-1)
    return np.lib.stride_tricks.sliding_window_view(raised, 2 * window + 1, axis=0).mean(axis=-1)
