"""The colours of a clip.

Agents take the colours of Okabe and Ito's palette, which people with any of the common colour-vision
deficiencies can tell apart, ordered so that neighbours in a leg differ in lightness as well as in hue. The legend of
the page shows the same strings.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import copy
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.rendering.settings import RenderSettings

#: colour of agent n is AGENT_COLOURS[n % 8]
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

#: parts that no agent moves: the torso, the head
BODY_COLOUR = "#AEB4BB"
BACKDROP_COLOUR = "#252C36"
FLOOR_COLOURS = ("#303945", "#48535F")
SHADOW_COLOUR = "#14191F"
#: posts at every metre, and the line where the clip began
POST_COLOUR = "#717D8A"
START_COLOUR = "#E8ECF0"


def agent_colour(agent: int) -> str:
    """The colour of one agent, as `#RRGGBB`. Teams larger than the palette go round again."""
    return AGENT_COLOURS[agent % len(AGENT_COLOURS)]


def rgb_bytes(colour: str) -> tuple[int, int, int]:
    """`#RRGGBB` as three numbers from 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def rgba(colour: str) -> tuple[float, float, float, float]:
    """`#RRGGBB` as MuJoCo wants it: four numbers from 0 to 1, opaque."""
    red, green, blue = rgb_bytes(colour)
    return red / 255, green / 255, blue / 255, 1.0


#: vertical angle of view in degrees; narrow, so that the body's size does not change along the frame
VIEW_ANGLE_DEGREES = 25.0


def painted(
    model: mujoco.MjModel, agent_geoms: Sequence[Sequence[int]], settings: RenderSettings, square_metres: float = 0.5
) -> mujoco.MjModel:
    """A copy of the model as clips show it.

    Args:
        model: any model with a floor plane or without.
        agent_geoms: ids of the geoms that each of the N agents moves; the first of several colours a geom.
        settings: size and quality.
        square_metres: side of the floor's squares; half a metre is passed in three frames of 20 Hz at 3 m/s.

    Raises:
        ValueError: if a geom is not of the model.
    """
    model = copy.copy(model)
    _colour_geoms(model, agent_geoms)
    _paint_floors(model, square_metres)
    _light_evenly(model)
    _set_quality(model, settings)
    return model


def has_squares(model: mujoco.MjModel) -> bool:
    """Whether a floor of the model has a texture, which is painted in squares."""
    materials = model.geom_matid[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE]
    return bool((model.mat_texid[materials[materials >= 0], mujoco.mjtTextureRole.mjTEXROLE_RGB] >= 0).any())


def moving_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Ids of the geoms that belong to the body: not fixed to the world."""
    return np.flatnonzero(model.body_weldid[model.geom_bodyid] != 0)


def _colour_geoms(model: mujoco.MjModel, agent_geoms: Sequence[Sequence[int]]) -> None:
    for agent, geoms in enumerate(agent_geoms):
        for geom in geoms:
            if not 0 <= geom < model.ngeom:
                raise ValueError(f"Agent {agent} moves geom {geom}, but the model has {model.ngeom} geoms.")
    solid = np.flatnonzero(model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    body = moving_geoms(model)
    model.geom_matid[solid] = -1  # a material's texture would tint the colour
    model.geom_rgba[np.setdiff1d(solid, body)] = rgba(POST_COLOUR)
    # A target or a thing to be pushed is no part of the team's body: it keeps its own colour.
    roots = model.body_rootid[model.geom_bodyid]
    ours = np.isin(roots[body], roots[[geom for geoms in agent_geoms for geom in geoms]])
    model.geom_rgba[body[ours]] = rgba(BODY_COLOUR)
    model.geom_rgba[body, 3] = 1
    for agent, geoms in reversed(list(enumerate(agent_geoms))):
        model.geom_rgba[list(geoms)] = rgba(agent_colour(agent))


def _paint_floors(model: mujoco.MjModel, square_metres: float) -> None:
    model.mat_reflectance[:] = 0
    model.mat_specular[:] = 0
    for floor in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        _paint_floor(model, int(floor), square_metres)


def _paint_floor(model: mujoco.MjModel, floor: int, square_metres: float) -> None:
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
    # A texture holds two squares a side and is laid out over the whole plane (half sizes in geom_size).
    model.mat_texuniform[material] = False
    model.mat_texrepeat[material] = model.geom_size[floor, :2] / square_metres


def _texels(model: mujoco.MjModel, texture: int) -> np.ndarray:
    """The pixels of a texture (height,width,channels), writable in place."""
    height, width = model.tex_height[texture], model.tex_width[texture]
    channels, start = model.tex_nchannel[texture], model.tex_adr[texture]
    return model.tex_data[start : start + height * width * channels].reshape(height, width, channels)


def _light_evenly(model: mujoco.MjModel) -> None:
    """Most light from everywhere, so that a limb has its legend's colour; some from above, so that it is round."""
    model.vis.headlight.active = 1
    model.vis.headlight.ambient[:] = 0.55
    model.vis.headlight.diffuse[:] = 0.35
    model.vis.headlight.specular[:] = 0
    model.light_diffuse[:] = 0.25
    model.light_ambient[:] = 0
    model.light_specular[:] = 0
    # The far floor fades into the backdrop: squares behind the body would distract, and cost bytes.
    model.vis.rgba.fog[:] = rgba(BACKDROP_COLOUR)


def _set_quality(model: mujoco.MjModel, settings: RenderSettings) -> None:
    model.vis.global_.fovy = VIEW_ANGLE_DEGREES
    model.vis.global_.offwidth, model.vis.global_.offheight = settings.width, settings.height
    quality = model.vis.quality
    if settings.quality == "pretty":
        quality.offsamples, quality.shadowsize = 4, 1024
    else:
        # The default shadow map of 4096 pixels costs most of a frame on a software renderer, then anti-aliasing.
        quality.offsamples, quality.shadowsize = 0, 0
        quality.numslices, quality.numstacks, quality.numquads = 12, 6, 1


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
