"""How a model is painted before it is drawn: agents' colours, a quiet floor, even light.

Everything here changes a copy of the model: how it looks, never how it moves.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from mapt.rendering.colours import (
    BACKDROP_COLOUR,
    BODY_COLOUR,
    FLOOR_COLOURS,
    POST_COLOUR,
    agent_colour,
    rgb_bytes,
    rgba,
)
from mapt.rendering.settings import RenderSettings

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
