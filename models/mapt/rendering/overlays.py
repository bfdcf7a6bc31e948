"""Geoms that are added to each frame: ground, shadows, distance posts, start line, and rings around limbs."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.rendering.appearance import (
    BACKDROP_COLOUR,
    FLOOR_COLOURS,
    POST_COLOUR,
    SHADOW_COLOUR,
    START_COLOUR,
    agent_colour,
    rgba,
    stripe_colour,
)

# Sizes of the added geoms, in squares of the floor, so that they scale with the robot.
#: parts above this height have no contact shadow; lower parts have a larger one
SHADOW_MAX_HEIGHT = 0.7
#: distance between posts; a metre for most robots
POST_SPACING = 2
#: one post of this many is tall
TALL_POST_EVERY = 5
#: distance of the posts behind the robot's plane
POST_DISTANCE = 1.8
#: distance behind the robot at which the floor has faded into the backdrop and ends
BACKDROP_DISTANCE = 10.0
#: radius of a ring, and of a stripe, over that of its limb
RING_RADIUS, STRIPE_RADIUS = 1.06, 1.1
#: half length of a stripe over the radius of its limb
STRIPE_WIDTH = 0.25
#: most stripes on the part of a limb that shows one agent, and their distance in radii of the limb
MAX_STRIPES, STRIPE_SPACING = 3, 1.6

_BOX = mujoco.mjtGeom.mjGEOM_BOX
_CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
_ELLIPSOID = mujoco.mjtGeom.mjGEOM_ELLIPSOID
_SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE
_UPRIGHT = np.eye(3).ravel()
_SHADOW = np.array(rgba(SHADOW_COLOUR), dtype=np.float32)
_BACKDROP = np.array(rgba(BACKDROP_COLOUR), dtype=np.float32)
_POST = np.array(rgba(POST_COLOUR), dtype=np.float32)
_GRID = np.array(rgba(FLOOR_COLOURS[1]), dtype=np.float32)
_START = np.array(rgba(START_COLOUR), dtype=np.float32)


def add_ground(scene: mujoco.MjvScene, centre: NDArray[np.float64], below: float, square: float) -> None:
    """Add a plain ground below the floor, for where the floor ends within the view or is missing.

    Args:
        below: its height in metres.
        square: the side of a square of the floor in metres, here and in the functions below.
    """
    _add(scene, _BOX, (100 * square, 100 * square, 0.001), (centre[0], centre[1], below), _BACKDROP)


def add_backdrop(scene: mujoco.MjvScene, centre: NDArray[np.float64], square: float) -> None:
    """Add a wall where the floor has faded. It is cheaper than a sky texture and hides the rest of the floor.

    Args:
        centre: the camera's target in metres (3,).
    """
    _add(
        scene,
        _BOX,
        (100 * square, 0.01, 100 * square),
        (centre[0], centre[1] + BACKDROP_DISTANCE * square, 0.0),
        _BACKDROP,
    )


def add_shadows(
    scene: mujoco.MjvScene, boxes: tuple[NDArray[np.float64], NDArray[np.float64]], floor: float, square: float
) -> None:
    """Add a contact shadow under each part that is near the floor.

    Args:
        boxes: centres and half sizes of the parts' bounding boxes in metres (parts, 3).
        floor: its height in metres.
    """
    centre, half = boxes
    nearness = 1 - (centre[:, 2] - half[:, 2] - floor) / (SHADOW_MAX_HEIGHT * square)
    for box_centre, box_half, near in zip(centre, half, np.clip(nearness, 0, 1), strict=True):
        if near > 0:
            # Wider than a thin limb, so that it is visible from the side.
            across = max(box_half[1], min(0.09 * square + box_half[1], 1.8 * box_half[1]))
            size = (box_half[0] * near, across * near, 0.004 * square)
            _add(scene, _ELLIPSOID, size, (box_centre[0], box_centre[1], floor), _SHADOW)


def add_posts(scene: mujoco.MjvScene, centre: NDArray[np.float64], reach: float, floor: float, square: float) -> None:
    """Add distance posts along the x axis within the view, at fixed places in the world.

    Args:
        centre: the camera's target in metres (3,).
        reach: distance in metres from there to the last post.
    """
    spacing = POST_SPACING * square
    first, last = (int(np.ceil((centre[0] + side * reach) / spacing)) for side in (-1, 1))
    thickness, behind = 0.028 * square, POST_DISTANCE * square
    for post in range(first, last):
        half_height = (0.44 if post % TALL_POST_EVERY == 0 else 0.18) * square
        position = (post * spacing, centre[1] + behind, floor + half_height)
        _add(scene, _BOX, (thickness, thickness, half_height), position, _POST)


def add_start_line(scene: mujoco.MjvScene, start: NDArray[np.float64], floor: float, square: float) -> None:
    """Add a line on the floor at the body's first position in the clip, `start` (3,) in metres."""
    _add(scene, _BOX, (0.03 * square, POST_DISTANCE * square, 0.002 * square), (start[0], start[1], floor), _START)


def add_grid(scene: mujoco.MjvScene, centre: NDArray[np.float64], reach: float, floor: float, square: float) -> None:
    """Add a grid to a floor without squares, so that motion is visible.

    Args:
        centre: the camera's target in metres (3,).
        reach: distance in metres from there to the end of the lines.
    """
    count = int(np.ceil(reach / square))
    middle = np.round(centre[:2] / square).astype(int)
    thin, length = 0.02 * square, count * square
    for line in range(-count, count + 1):
        x, y = (middle + line) * square
        _add(scene, _BOX, (thin, length, 0.001 * square), (x, middle[1] * square, floor), _GRID)
        _add(scene, _BOX, (length, thin, 0.001 * square), (middle[0] * square, y, floor), _GRID)


def add_rings(scene: mujoco.MjvScene, data: mujoco.MjData, movers: Mapping[int, Sequence[int]]) -> None:
    """Add rings in the agents' colours around limbs that several agents move, and the stripes of repeated colours.

    A limb of k agents has k equal parts along its axis, one for each. The first one keeps the limb's own colour.

    Args:
        movers: agents by geom; of the shapes in `RINGED` only.
    """
    for geom, agents in movers.items():
        limb = _Limb.of(data, geom)
        radius, part = max(limb.sides), limb.half_length / len(agents)
        for position, agent in enumerate(agents):
            centre = limb.half_length * ((2 * position + 1) / len(agents) - 1)
            if position:
                limb.add_ring(scene, centre, 0.7 * part, RING_RADIUS, agent_colour(agent))
            colour = stripe_colour(agent)
            if colour is None:
                continue
            count = max(1, min(MAX_STRIPES, int(2 * part / (STRIPE_SPACING * radius))))
            for stripe in range(count):
                place = centre + STRIPE_SPACING * radius * (stripe - (count - 1) / 2)
                limb.add_ring(scene, place, STRIPE_WIDTH * radius, STRIPE_RADIUS, colour)


@dataclass(frozen=True, slots=True)
class _Limb:
    """A geom around which rings can be put."""

    centre: NDArray[np.float64]
    #: (3, 3), with its axis as the last column
    frame: NDArray[np.float64]
    half_length: float
    #: half sizes across the axis, along the first two columns of the frame
    sides: tuple[float, float]
    #: whether it is thinner towards its ends
    curved: bool
    #: shape of a ring
    ring: mujoco.mjtGeom

    @classmethod
    def of(cls, data: mujoco.MjData, geom: int) -> "_Limb":
        """The axis of a capsule and a cylinder is z, that of other shapes their longest, x if all are as long."""
        shape, size = mujoco.mjtGeom(int(data.model.geom_type[geom])), data.model.geom_size[geom]
        frame = data.geom_xmat[geom].reshape(3, 3)
        if shape in (_BOX, _ELLIPSOID, _SPHERE):
            sizes = size[[0, 0, 0]] if shape == _SPHERE else size
            axis = int(sizes.argmax())
            others = [(axis + 1) % 3, (axis + 2) % 3]
            frame, half_length, sides = frame[:, [*others, axis]], sizes[axis], sizes[others]
        else:
            half_length, sides = size[1], size[[0, 0]]
        curved = shape in (_SPHERE, _ELLIPSOID)
        ring = _BOX if shape == _BOX else _CYLINDER
        return cls(data.geom_xpos[geom], frame, float(half_length), (float(sides[0]), float(sides[1])), curved, ring)

    def add_ring(self, scene: mujoco.MjvScene, place: float, half_width: float, scale: float, colour: str) -> None:
        """Add a ring at this distance from the centre along the axis.

        Args:
            scale: its size over that of the limb there.
        """
        if self.curved:
            widest = min(1.0, max(0.0, abs(place) - half_width) / self.half_length)
            scale *= np.sqrt(1 - widest**2)
        size = (scale * self.sides[0], scale * self.sides[1], half_width)
        position, opaque = self.centre + place * self.frame[:, 2], np.array(rgba(colour), dtype=np.float32)
        _add(scene, self.ring, size, position, opaque, rotation=self.frame.ravel())
        # mjv_initGeom makes every cylinder round.
        scene.geoms[scene.ngeom - 1].size[:] = size


def _add(
    scene: mujoco.MjvScene,
    shape: mujoco.mjtGeom,
    size: tuple[float, float, float],
    position: tuple[float, float, float] | NDArray[np.float64],
    colour: NDArray[np.float32],
    *,
    rotation: NDArray[np.float64] = _UPRIGHT,
) -> None:
    mujoco.mjv_initGeom(scene.geoms[scene.ngeom], shape, np.array(size), np.array(position), rotation, colour)
    scene.ngeom += 1
