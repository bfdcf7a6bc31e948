"""Colours and dynamics of the styled model."""

import numpy as np
import pytest

from mapt.rendering.appearance import AGENT_COLOURS, BODY_COLOUR, POST_COLOUR, moving_geoms, rgba, styled_model
from mapt.rendering.settings import RenderSettings
from mapt.tasks import agent_geoms, load_model

DYNAMICS_FIELDS = ("geom_size", "geom_pos", "body_pos", "body_mass", "jnt_range", "actuator_gainprm", "qpos0")


@pytest.mark.parametrize("task", ["HalfCheetah-6x1", "HalfCheetah-2x3"])
def test_geoms_have_their_agents_colour_and_other_parts_the_body_colour(task: str) -> None:
    model = styled_model(load_model(task), agent_geoms(task), RenderSettings())
    owner = {geom: agent for agent, geoms in enumerate(agent_geoms(task)) for geom in geoms}
    for geom in moving_geoms(model):
        colour = AGENT_COLOURS[owner[geom]] if geom in owner else BODY_COLOUR
        np.testing.assert_allclose(model.geom_rgba[geom], rgba(colour), rtol=1e-6)


def test_moving_geoms_are_torso_and_limbs_without_the_floor() -> None:
    model = load_model("HalfCheetah-6x1")
    names = [model.geom(geom).name for geom in moving_geoms(model)]
    assert names == ["torso", "head", "bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]


def test_styling_does_not_change_the_given_model() -> None:
    model, untouched = load_model("HalfCheetah-6x1"), load_model("HalfCheetah-6x1")
    styled_model(model, agent_geoms("HalfCheetah-6x1"), RenderSettings())
    np.testing.assert_array_equal(model.geom_rgba, untouched.geom_rgba)
    np.testing.assert_array_equal(model.tex_data, untouched.tex_data)


def test_styling_does_not_change_the_dynamics() -> None:
    model = load_model("HalfCheetah-6x1")
    copy = styled_model(model, agent_geoms("HalfCheetah-6x1"), RenderSettings())
    for field in DYNAMICS_FIELDS:
        np.testing.assert_array_equal(getattr(copy, field), getattr(model, field))


@pytest.mark.parametrize("geom", [-1, 99])
def test_unknown_geom_is_rejected(geom: int) -> None:
    with pytest.raises(ValueError, match="the model has 9 geoms"):
        styled_model(load_model("HalfCheetah-6x1"), [[3], [geom]], RenderSettings())


def test_target_keeps_its_colour_and_arm_has_its_agents_colour() -> None:
    given = load_model("Reacher-2x1")
    model = styled_model(given, agent_geoms("Reacher-2x1"), RenderSettings())
    target, tip, wall = (given.geom(name).id for name in ("target", "fingertip", "sideN"))
    np.testing.assert_allclose(model.geom_rgba[target], given.geom_rgba[target])
    np.testing.assert_allclose(model.geom_rgba[tip], rgba(AGENT_COLOURS[1]), rtol=1e-6)
    np.testing.assert_allclose(model.geom_rgba[wall], rgba(POST_COLOUR), rtol=1e-6)
