"""What a clip shows beside the body: backdrop, contact shadows, a post at every metre, the line where it began.

They are drawn into the scene, so that speed and distance can be read without a shadow map or text.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.rendering.colours import BACKDROP_COLOUR, POST_COLOUR, SHADOW_COLOUR, START_COLOUR, rgba

#: a part higher than this casts no shadow, metres; the lower, the wider its shadow
SHADOW_REACH_METRES = 0.35
POST_SPACING_METRES = 1.0
#: every so many posts one is tall
TALL_POST_EVERY = 5
#: how far behind the body's plane the posts stand
POST_DISTANCE_METRES = 0.9
#: how far behind the body the floor has faded into the backdrop, and ends
BACKDROP_METRES = 5.0

_BOX = mujoco.mjtGeom.mjGEOM_BOX
_ELLIPSOID = mujoco.mjtGeom.mjGEOM_ELLIPSOID
_UPRIGHT = np.eye(3).ravel()
_SHADOW = np.array(rgba(SHADOW_COLOUR), dtype=np.float32)
_BACKDROP = np.array(rgba(BACKDROP_COLOUR), dtype=np.float32)
_POST = np.array(rgba(POST_COLOUR), dtype=np.float32)
_START = np.array(rgba(START_COLOUR), dtype=np.float32)


def add_backdrop(scene: mujoco.MjvScene, middle: float) -> None:
    """A wall where the floor has faded: cheaper than a sky's texture, and hides the floor that is too far to see.

    Args:
        middle: where the camera looks, metres along.
    """
    _add(scene, _BOX, (50.0, 0.01, 50.0), (middle, BACKDROP_METRES, 0.0), _BACKDROP)


def add_shadows(scene: mujoco.MjvScene, centre: NDArray[np.float64], half: NDArray[np.float64]) -> None:
    """A flat dark spot under each part that is near the floor: limb and spot meet where it touches.

    Args:
        centre, half: the parts' bounding boxes, metres (parts,3).
    """
    nearness = 1 - (centre[:, 2] - half[:, 2]) / SHADOW_REACH_METRES
    for box_centre, box_half, near in zip(centre, half, np.clip(nearness, 0, 1), strict=True):
        if near > 0:
            size = (box_half[0] * near, box_half[1] * 1.8 * near, 0.002)
            _add(scene, _ELLIPSOID, size, (box_centre[0], box_centre[1], 0.0), _SHADOW)


def add_marks(scene: mujoco.MjvScene, middle: float, half_width: float, start: float) -> None:
    """Posts along what is in view, counted from the world's origin, and the line where the body started.

    Args:
        middle: where the camera looks, metres along.
        half_width: from there to the edge of the view, metres.
        start: where the clip began, metres along.
    """
    reach = half_width * 1.5
    first, last = (int(np.ceil((middle + side * reach) / POST_SPACING_METRES)) for side in (-1, 1))
    for post in range(first, last):
        half_height = 0.22 if post % TALL_POST_EVERY == 0 else 0.09
        along = post * POST_SPACING_METRES
        _add(scene, _BOX, (0.014, 0.014, half_height), (along, POST_DISTANCE_METRES, half_height), _POST)
    if abs(start - middle) < reach:
        _add(scene, _BOX, (0.025, POST_DISTANCE_METRES, 0.001), (start, 0.0, 0.0), _START)


def _add(
    scene: mujoco.MjvScene,
    shape: mujoco.mjtGeom,
    size: tuple[float, float, float],
    position: tuple[float, float, float],
    colour: NDArray[np.float32],
) -> None:
    mujoco.mjv_initGeom(scene.geoms[scene.ngeom], shape, np.array(size), np.array(position), _UPRIGHT, colour)
    scene.ngeom += 1
