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
    agent_colour,
    rgb_bytes,
    rgba,
)
from mapt.rendering.settings import RenderSettings

#: side of a square of the floor; a body at 5 m/s passes one in three frames of 20 Hz
FLOOR_SQUARE_METRES = 0.5
#: vertical angle of view in degrees; narrow, so that the body's size does not change along the frame
VIEW_ANGLE_DEGREES = 25.0


def painted(model: mujoco.MjModel, agent_geoms: Sequence[Sequence[int]], settings: RenderSettings) -> mujoco.MjModel:
    """A copy of the model as clips show it.

    Args:
        model: any model with a floor plane or without.
        agent_geoms: ids of the geoms that each of the N agents moves.
        settings: size and quality.

    Raises:
        ValueError: if a geom is not of the model.
    """
    model = copy.copy(model)
    _colour_geoms(model, agent_geoms)
    _paint_floors(model)
    _light_evenly(model)
    _set_quality(model, settings)
    return model


def moving_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Ids of the geoms that belong to the body: not fixed to the world."""
    return np.flatnonzero(model.body_weldid[model.geom_bodyid] != 0)


def _colour_geoms(model: mujoco.MjModel, agent_geoms: Sequence[Sequence[int]]) -> None:
    body = moving_geoms(model)
    model.geom_matid[body] = -1  # a material's texture would tint the colour
    model.geom_rgba[body] = rgba(BODY_COLOUR)
    for agent, geoms in enumerate(agent_geoms):
        for geom in geoms:
            if not 0 <= geom < model.ngeom:
                raise ValueError(f"Agent {agent} moves geom {geom}, but the model has {model.ngeom} geoms.")
            model.geom_rgba[geom] = rgba(agent_colour(agent))


def _paint_floors(model: mujoco.MjModel) -> None:
    model.mat_reflectance[:] = 0
    model.mat_specular[:] = 0
    for floor in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        _paint_floor(model, int(floor))


def _paint_floor(model: mujoco.MjModel, floor: int) -> None:
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
    model.mat_texrepeat[material] = model.geom_size[floor, :2] / FLOOR_SQUARE_METRES


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
