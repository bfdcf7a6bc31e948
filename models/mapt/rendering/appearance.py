"""The appearance of clips: the colours, the model in these colours, and the geoms that are added to each frame.

Agents have the colours of Okabe and Ito's palette, which people with any of the common colour-vision deficiencies can
distinguish. They are ordered so that neighbours in a leg differ in lightness as well as in hue. The page's legend shows
the same colours.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import copy
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.rendering.settings import RenderSettings

#: agent n has AGENT_COLOURS[n % 8]
AGENT_COLOURS: tuple[str, ...] = (
    "#E69F00",  # orange
    "#0072B2",  # blue
    "#56B4E9",  # sky blue
    "#D55E00",  # vermilion
    "#F0E442",  # yellow
    "#CC79A7",  # reddish purple
    "#009E73",  # bluish green
    "#FFFFFF",  # white
)

#: parts that no agent moves, such as the torso
BODY_COLOUR = "#AEB4BB"
BACKDROP_COLOUR = "#252C36"
FLOOR_COLOURS = ("#303945", "#48535F")
SHADOW_COLOUR = "#14191F"
#: distance posts, and the line at the start position
POST_COLOUR = "#717D8A"
START_COLOUR = "#E8ECF0"


def agent_colour(agent: int) -> str:
    """The colour of an agent as `#RRGGBB`. Colours repeat in teams larger than the palette."""
    return AGENT_COLOURS[agent % len(AGENT_COLOURS)]


def rgb_bytes(colour: str) -> tuple[int, int, int]:
    """`#RRGGBB` as three numbers from 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def rgba(colour: str) -> tuple[float, float, float, float]:
    """`#RRGGBB` as MuJoCo's four numbers from 0 to 1, opaque."""
    red, green, blue = rgb_bytes(colour)
    return red / 255, green / 255, blue / 255, 1.0


#: vertical angle of view in degrees; narrow, so that perspective hardly changes the body's size within the frame
VIEW_ANGLE_DEGREES = 25.0

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
#: radius of a ring over that of its limb
RING_RADIUS = 1.06

_BOX = mujoco.mjtGeom.mjGEOM_BOX
_CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
_ELLIPSOID = mujoco.mjtGeom.mjGEOM_ELLIPSOID
_UPRIGHT = np.eye(3).ravel()
_SHADOW = np.array(rgba(SHADOW_COLOUR), dtype=np.float32)
_BACKDROP = np.array(rgba(BACKDROP_COLOUR), dtype=np.float32)
_POST = np.array(rgba(POST_COLOUR), dtype=np.float32)
_GRID = np.array(rgba(FLOOR_COLOURS[1]), dtype=np.float32)
_START = np.array(rgba(START_COLOUR), dtype=np.float32)


def styled_model(
    model: mujoco.MjModel, agent_geoms: Sequence[Sequence[int]], settings: RenderSettings, square_metres: float = 0.5
) -> mujoco.MjModel:
    """A copy of the model with the colours, light and quality of clips. Its dynamics are unchanged.

    Args:
        model: with or without a floor plane.
        agent_geoms: ids of the geoms that each of the N agents moves. A geom of several agents gets the
            first one's colour.
        settings: size and quality.
        square_metres: side of the floor's squares. At 3 m/s and 20 Hz, half a metre passes in three frames.

    Raises:
        ValueError: if the model lacks a geom.
    """
    model = copy.copy(model)
    _colour_geoms(model, agent_geoms)
    _colour_floors(model, square_metres)
    _set_light(model)
    _set_quality(model, settings)
    return model


def has_squares(model: mujoco.MjModel) -> bool:
    """Whether a floor of the model has a texture; `styled_model` replaces it by squares."""
    materials = model.geom_matid[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE]
    return bool((model.mat_texid[materials[materials >= 0], mujoco.mjtTextureRole.mjTEXROLE_RGB] >= 0).any())


def moving_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Ids of the geoms that are not fixed to the world."""
    return np.flatnonzero(model.body_weldid[model.geom_bodyid] != 0)


def _colour_geoms(model: mujoco.MjModel, agent_geoms: Sequence[Sequence[int]]) -> None:
    for agent, geoms in enumerate(agent_geoms):
        for geom in geoms:
            if not 0 <= geom < model.ngeom:
                raise ValueError(f"Agent {agent} moves geom {geom}, but the model has {model.ngeom} geoms.")
    solid = np.flatnonzero(model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    body = moving_geoms(model)
    model.geom_matid[solid] = -1  # a material's texture changes the colour
    model.geom_rgba[np.setdiff1d(solid, body)] = rgba(POST_COLOUR)
    # A target or an object to push is not part of the robot and keeps its own colour.
    roots = model.body_rootid[model.geom_bodyid]
    of_robot = np.isin(roots[body], roots[[geom for geoms in agent_geoms for geom in geoms]])
    model.geom_rgba[body[of_robot]] = rgba(BODY_COLOUR)
    model.geom_rgba[body, 3] = 1
    for agent, geoms in reversed(list(enumerate(agent_geoms))):
        model.geom_rgba[list(geoms)] = rgba(agent_colour(agent))


def _colour_floors(model: mujoco.MjModel, square_metres: float) -> None:
    model.mat_reflectance[:] = 0
    model.mat_specular[:] = 0
    for floor in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        _colour_floor(model, int(floor), square_metres)


def _colour_floor(model: mujoco.MjModel, floor: int, square_metres: float) -> None:
    model.geom_rgba[floor] = 1
    material = model.geom_matid[floor]
    if material < 0:
        model.geom_rgba[floor] = rgba(FLOOR_COLOURS[0])
        return
    model.mat_rgba[material] = 1
    texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    if texture < 0:
        return
    texels = _texels(model, texture)
    rows, columns = np.indices(texels.shape[:2])
    light = (rows >= texels.shape[0] // 2) ^ (columns >= texels.shape[1] // 2)
    texels[:] = np.where(light[..., None], rgb_bytes(FLOOR_COLOURS[1]), rgb_bytes(FLOOR_COLOURS[0]))
    # A texture has two squares per side and is repeated over the whole plane (geom_size holds half sizes).
    model.mat_texuniform[material] = False
    model.mat_texrepeat[material] = model.geom_size[floor, :2] / square_metres


def _texels(model: mujoco.MjModel, texture: int) -> np.ndarray:
    """The pixels of a texture (height, width, channels), writable in place."""
    height, width = model.tex_height[texture], model.tex_width[texture]
    channels, start = model.tex_nchannel[texture], model.tex_adr[texture]
    return model.tex_data[start : start + height * width * channels].reshape(height, width, channels)


def _set_light(model: mujoco.MjModel) -> None:
    """Mostly ambient light, so that limbs have the legend's colours; some from above, so that they look round."""
    model.vis.headlight.active = 1
    model.vis.headlight.ambient[:] = 0.55
    model.vis.headlight.diffuse[:] = 0.35
    model.vis.headlight.specular[:] = 0
    model.light_diffuse[:] = 0.25
    model.light_ambient[:] = 0
    model.light_specular[:] = 0
    # The far floor fades into the backdrop: squares behind the body distract and cost bytes.
    model.vis.rgba.fog[:] = rgba(BACKDROP_COLOUR)


def _set_quality(model: mujoco.MjModel, settings: RenderSettings) -> None:
    model.vis.global_.fovy = VIEW_ANGLE_DEGREES
    model.vis.global_.offwidth, model.vis.global_.offheight = settings.width, settings.height
    quality = model.vis.quality
    if settings.quality == "pretty":
        quality.offsamples, quality.shadowsize = 4, 1024
    else:
        # On a software renderer, the default shadow map of 4096 pixels takes most of the time,
        # anti-aliasing the next most.
        quality.offsamples, quality.shadowsize = 0, 0
        quality.numslices, quality.numstacks, quality.numquads = 12, 6, 1


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
        _add(scene, _BOX, (thickness, thickness, half_height), (post * spacing, behind, floor + half_height), _POST)


def add_start_line(scene: mujoco.MjvScene, start: NDArray[np.float64], floor: float, square: float) -> None:
    """Add a line on the floor at the body's first position in the clip, `start` (3,) in metres."""
    _add(scene, _BOX, (0.05 * square, POST_DISTANCE * square, 0.002 * square), (start[0], start[1], floor), _START)


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


def add_rings(scene: mujoco.MjvScene, data: mujoco.MjData, shared: Mapping[int, Sequence[int]]) -> None:
    """Add a ring in the colour of each agent but the first around limbs that several agents move.

    Args:
        shared: agents by geom; capsules and cylinders only.
    """
    for geom, agents in shared.items():
        radius, half = data.model.geom_size[geom, :2]
        rotation, axis = data.geom_xmat[geom], data.geom_xmat[geom].reshape(3, 3)[:, 2]
        for position, agent in enumerate(agents[1:], start=1):
            along = half * ((2 * position + 1) / len(agents) - 1)
            size = (radius * RING_RADIUS, radius * RING_RADIUS, half / len(agents) * 0.7)
            colour = np.array(rgba(agent_colour(agent)), dtype=np.float32)
            _add(scene, _CYLINDER, size, data.geom_xpos[geom] + along * axis, colour, rotation=rotation)


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
