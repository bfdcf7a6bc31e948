"""What a clip shows beside the body: backdrop, contact shadows, posts, a grid, the line where it began, agents' bands.

They are drawn into the scene, so that speed and distance can be read without a shadow map or text. Sizes are for a body
on squares of half a metre, and grow with the squares.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.rendering.colours import (
    BACKDROP_COLOUR,
    FLOOR_COLOURS,
    POST_COLOUR,
    SHADOW_COLOUR,
    START_COLOUR,
    agent_colour,
    rgba,
)

#: a part higher than this casts no shadow, in squares; the lower, the wider its shadow
SHADOW_REACH = 0.7
#: squares from post to post: a metre, for most bodies
POST_SPACING = 2
#: every so many posts one is tall
TALL_POST_EVERY = 5
#: how far behind the body's plane the posts stand, in squares
POST_DISTANCE = 1.8
#: how far behind the body the floor has faded into the backdrop, and ends, in squares
BACKDROP = 10.0
#: a band's radius against its limb's
BAND_RADIUS = 1.06

_BOX = mujoco.mjtGeom.mjGEOM_BOX
_CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
_ELLIPSOID = mujoco.mjtGeom.mjGEOM_ELLIPSOID
_UPRIGHT = np.eye(3).ravel()
_SHADOW = np.array(rgba(SHADOW_COLOUR), dtype=np.float32)
_BACKDROP = np.array(rgba(BACKDROP_COLOUR), dtype=np.float32)
_POST = np.array(rgba(POST_COLOUR), dtype=np.float32)
_GRID = np.array(rgba(FLOOR_COLOURS[1]), dtype=np.float32)
_START = np.array(rgba(START_COLOUR), dtype=np.float32)


def add_ground(scene: mujoco.MjvScene, centre: NDArray[np.float64], below: float, square: float) -> None:
    """A plain ground under a floor that ends within the view, or is missing.

    Args:
        below: its height, metres.
    """
    _add(scene, _BOX, (100 * square, 100 * square, 0.001), (centre[0], centre[1], below), _BACKDROP)


def add_backdrop(scene: mujoco.MjvScene, centre: NDArray[np.float64], square: float) -> None:
    """A wall where the floor has faded: cheaper than a sky's texture, and hides the floor that is too far to see.

    Args:
        centre: what the camera looks at, metres (3,).
    """
    _add(scene, _BOX, (100 * square, 0.01, 100 * square), (centre[0], centre[1] + BACKDROP * square, 0.0), _BACKDROP)


def add_shadows(
    scene: mujoco.MjvScene, boxes: tuple[NDArray[np.float64], NDArray[np.float64]], floor: float, square: float
) -> None:
    """A flat dark spot under each part that is near the floor: limb and spot meet where it touches.

    Args:
        boxes: centres and half sizes of the parts' bounding boxes, metres (parts,3).
        floor: its height, metres.
    """
    centre, half = boxes
    nearness = 1 - (centre[:, 2] - half[:, 2] - floor) / (SHADOW_REACH * square)
    for box_centre, box_half, near in zip(centre, half, np.clip(nearness, 0, 1), strict=True):
        if near > 0:
            # Wider than a thin limb, so that it shows from the side.
            across = max(box_half[1], min(0.09 * square + box_half[1], 1.8 * box_half[1]))
            size = (box_half[0] * near, across * near, 0.004 * square)
            _add(scene, _ELLIPSOID, size, (box_centre[0], box_centre[1], floor), _SHADOW)


def add_posts(scene: mujoco.MjvScene, centre: NDArray[np.float64], reach: float, floor: float, square: float) -> None:
    """Posts along what is in view of a body that keeps to its plane, counted from the world's origin.

    Args:
        centre: what the camera looks at, metres (3,).
        reach: from there to the last post, metres.
    """
    spacing = POST_SPACING * square
    first, last = (int(np.ceil((centre[0] + side * reach) / spacing)) for side in (-1, 1))
    thickness, behind = 0.028 * square, POST_DISTANCE * square
    for post in range(first, last):
        half_height = (0.44 if post % TALL_POST_EVERY == 0 else 0.18) * square
        _add(scene, _BOX, (thickness, thickness, half_height), (post * spacing, behind, floor + half_height), _POST)


def add_start(scene: mujoco.MjvScene, start: NDArray[np.float64], floor: float, square: float) -> None:
    """The line across the way where the body was when the clip began, metres (3,)."""
    _add(scene, _BOX, (0.05 * square, POST_DISTANCE * square, 0.002 * square), (start[0], start[1], floor), _START)


def add_grid(scene: mujoco.MjvScene, centre: NDArray[np.float64], reach: float, floor: float, square: float) -> None:
    """Lines on a floor that has no squares of its own, so that motion shows.

    Args:
        centre: what the camera looks at, metres (3,).
        reach: from there to the end of the lines, metres.
    """
    count = int(np.ceil(reach / square))
    middle = np.round(centre[:2] / square).astype(int)
    thin, length = 0.02 * square, count * square
    for line in range(-count, count + 1):
        x, y = (middle + line) * square
        _add(scene, _BOX, (thin, length, 0.001 * square), (x, middle[1] * square, floor), _GRID)
        _add(scene, _BOX, (length, thin, 0.001 * square), (middle[0] * square, y, floor), _GRID)


def add_bands(scene: mujoco.MjvScene, data: mujoco.MjData, shared: Mapping[int, Sequence[int]]) -> None:
    """Rings around limbs that several agents move: the limb has the first one's colour, a ring each of the others'.

    Args:
        shared: agents by geom, capsules and cylinders alone.
    """
    for geom, agents in shared.items():
        radius, half = data.model.geom_size[geom, :2]
        turn, axis = data.geom_xmat[geom], data.geom_xmat[geom].reshape(3, 3)[:, 2]
        for place, agent in enumerate(agents[1:], start=1):
            along = half * ((2 * place + 1) / len(agents) - 1)
            size = (radius * BAND_RADIUS, radius * BAND_RADIUS, half / len(agents) * 0.7)
            colour = np.array(rgba(agent_colour(agent)), dtype=np.float32)
            _add(scene, _CYLINDER, size, data.geom_xpos[geom] + along * axis, colour, turn=turn)


def _add(
    scene: mujoco.MjvScene,
    shape: mujoco.mjtGeom,
    size: tuple[float, float, float],
    position: tuple[float, float, float] | NDArray[np.float64],
    colour: NDArray[np.float32],
    *,
    turn: NDArray[np.float64] = _UPRIGHT,
) -> None:
    mujoco.mjv_initGeom(scene.geoms[scene.ngeom], shape, np.array(size), np.array(position), turn, colour)
    scene.ngeom += 1
