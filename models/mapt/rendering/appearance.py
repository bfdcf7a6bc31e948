"""The appearance of clips: the colours, and the model in these colours. `overlays` adds geoms to each frame.

Agents have the colours of Okabe and Ito's palette, which people with any of the common colour-vision deficiencies can
distinguish. They are ordered so that neighbours in a leg differ in lightness as well as in hue. Colours repeat after
eight agents; the limbs of the next eight have dark stripes, those of the next eight light ones. The page's legend shows
the same colours and stripes.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

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
#: distance posts, and the line at the start position, which is less bright than the body
POST_COLOUR = "#717D8A"
START_COLOUR = "#7E8A97"
#: stripes of agents 8 to 15 and 16 to 23
STRIPE_COLOURS = ("#14191F", "#FFFFFF")


#: of geoms to which a model gives no colour
_MUJOCO_COLOUR = (0.5, 0.5, 0.5, 1.0)
#: shapes of limbs that are drawn thicker if they are thin
ROUND = (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)
#: shapes of limbs that can have rings and stripes
RINGED = (*ROUND, mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_BOX)
#: cosine above which two directions are the same
_ALONG = 0.99


def stripe_colour(agent: int) -> str | None:
    """The colour of the stripes on the limbs of an agent; None for the first eight agents, which have none."""
    repeats = agent // len(AGENT_COLOURS)
    return STRIPE_COLOURS[(repeats - 1) % len(STRIPE_COLOURS)] if repeats else None


def agent_colour(agent: int) -> str:
    """The colour of an agent as `#RRGGBB`. Colours repeat in teams larger than the palette; see `stripe_colour`."""
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
#: distance between limbs that move in the same plane, over the sum of their radii: their surfaces never touch
LIMB_CLEARANCE = 1.05
#: least radius of a limb in squares of the floor; thinner ones are drawn thicker, so that colours are visible
MIN_LIMB_RADIUS = 0.04
#: radius of every other limb of a chain over its own
ALTERNATE_RADIUS = 1.04


def styled_model(
    model: mujoco.MjModel, agent_geoms: Sequence[Sequence[int]], settings: RenderSettings, square_metres: float = 0.5
) -> mujoco.MjModel:
    """A copy of the model with the colours, light and quality of clips. Use it for drawing only.

    The limbs of a body that moves in a vertical plane lie beside each other instead of within each other, and very thin
    limbs are thicker.

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
    _separate_limbs(model)
    _set_radii(model, MIN_LIMB_RADIUS * square_metres)
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
    fixed = np.setdiff1d(solid, body)
    of_material = solid[model.geom_matid[solid] >= 0]
    model.geom_rgba[of_material] = model.mat_rgba[model.geom_matid[of_material]]
    model.geom_matid[solid] = -1  # a material's texture changes the colour
    # A goal that is fixed to the world, a target or an object to push keep the colours that the model gives them.
    colourless = (model.geom_rgba[fixed] == _MUJOCO_COLOUR).all(axis=1)
    model.geom_rgba[fixed[colourless]] = rgba(POST_COLOUR)
    roots = model.body_rootid[model.geom_bodyid]
    of_robot = np.isin(roots[body], roots[[geom for geoms in agent_geoms for geom in geoms]])
    model.geom_rgba[body[of_robot]] = rgba(BODY_COLOUR)
    for agent, geoms in reversed(list(enumerate(agent_geoms))):
        model.geom_rgba[list(geoms)] = rgba(agent_colour(agent))


def _separate_limbs(model: mujoco.MjModel) -> None:
    """Move limbs that start at the same body apart along y, where every hinge turns around the y axis.

    Otherwise they interpenetrate, and which one is visible changes from pixel to pixel.
    """
    hinges = model.jnt_axis[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]
    if not (np.abs(hinges[:, 1]) > _ALONG).all() or (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any():
        return
    for parent in range(1, model.nbody):
        limbs = [body for body in range(1, model.nbody) if model.body_parentid[body] == parent]
        radius = max((_radius(model, body) for body in limbs), default=0.0)
        for limb, body in enumerate(limbs):
            model.body_pos[body, 1] += 2 * LIMB_CLEARANCE * radius * (limb - (len(limbs) - 1) / 2)


def _radius(model: mujoco.MjModel, root: int) -> float:
    """The largest radius in metres of the geoms of a body and of those that hang on it."""
    bodies = {root}
    for body in range(root + 1, model.nbody):  # a parent comes before its children
        if model.body_parentid[body] in bodies:
            bodies.add(body)
    return float(model.geom_size[np.isin(model.geom_bodyid, list(bodies)), 0].max(initial=0.0))


def _set_radii(model: mujoco.MjModel, least: float) -> None:
    """Give capsules and cylinders at least this radius in metres, and every other one of a chain a larger radius.

    The ends of two limbs of the same radius would coincide, and their colours would mix.
    """
    depth = np.zeros(model.nbody, dtype=int)
    for body in range(1, model.nbody):  # a parent comes before its children
        depth[body] = depth[model.body_parentid[body]] + 1
    geoms = moving_geoms(model)
    geoms = geoms[np.isin(model.geom_type[geoms], ROUND)]
    every_other = np.where(depth[model.geom_bodyid[geoms]] % 2, 1.0, ALTERNATE_RADIUS)
    model.geom_size[geoms, 0] = np.maximum(model.geom_size[geoms, 0], least) * every_other


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
    # On a software renderer, the default shadow map of 4096 pixels takes most of the time, anti-aliasing the next most.
    quality.offsamples = 0 if settings.quality == "fast" else 4
    quality.shadowsize = 1024 if settings.quality == "pretty" else 0
    if settings.quality != "pretty":
        quality.numslices, quality.numstacks, quality.numquads = 12, 6, 1
