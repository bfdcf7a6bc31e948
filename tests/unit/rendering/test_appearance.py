"""Colours and limbs of the styled model."""

import mujoco
import numpy as np
import pytest

from mapt.rendering.appearance import (
    AGENT_COLOURS,
    BODY_COLOUR,
    POST_COLOUR,
    agent_colour,
    moving_geoms,
    rgba,
    stripe_colour,
    styled_model,
)
from mapt.rendering.camera import BodyKinematics
from mapt.rendering.settings import RenderSettings
from mapt.tasks import agent_geoms, load_model


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
    np.testing.assert_array_equal(model.geom_size, untouched.geom_size)
    np.testing.assert_array_equal(model.body_pos, untouched.body_pos)


@pytest.mark.parametrize("task", ["Walker2d-2x3", "HalfCheetah-6x1"])
def test_legs_that_move_in_one_plane_lie_beside_each_other(task: str) -> None:
    body = BodyKinematics(styled_model(load_model(task), agent_geoms(task), RenderSettings()))
    rng = np.random.default_rng(0)
    for _ in range(20):
        body.set_pose(rng.uniform(-2, 2, body.model.nq))
        centre, half = body.boxes(np.eye(3))
        left, right = (slice(-6, -3), slice(-3, None))
        least, most = (centre - half)[:, 1], (centre + half)[:, 1]
        assert least[left].min() > most[right].max() or least[right].min() > most[left].max()


def test_limbs_of_other_bodies_keep_their_places() -> None:
    for task in ("Ant-4x2", "Hopper-3x1", "Swimmer-2x1"):
        model = load_model(task)
        styled = styled_model(model, agent_geoms(task), RenderSettings())
        np.testing.assert_array_equal(styled.body_pos, model.body_pos)


def test_neighbouring_limbs_differ_in_radius() -> None:
    model = styled_model(
        load_model("ManySegmentSwimmer-10x2"), agent_geoms("ManySegmentSwimmer-10x2"), RenderSettings()
    )
    radii = model.geom_size[moving_geoms(model), 0]
    assert (np.abs(np.diff(radii)) > 0.02 * radii[:-1]).all()


def test_agents_of_the_same_colour_differ_in_their_stripes() -> None:
    seen = {(agent_colour(agent), stripe_colour(agent)) for agent in range(24)}
    assert len(seen) == 24


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


def test_a_goal_that_is_fixed_to_the_world_keeps_its_colour_and_a_wall_without_one_is_grey() -> None:
    given = mujoco.MjModel.from_xml_string("""
        <mujoco>
          <asset><material name="green" rgba="0 1 0 1"/></asset>
          <worldbody>
            <geom name="wall" type="box" size="1 1 1"/>
            <geom name="goal" type="sphere" size="0.1" rgba="1 0 0 1"/>
            <body name="flag"><geom name="cloth" type="box" size="0.1 0.1 0.1" material="green"/></body>
            <body><joint type="slide"/><geom name="agent" type="sphere" size="0.1" rgba="0 0 1 1"/></body>
          </worldbody>
        </mujoco>
    """)
    model = styled_model(given, [[given.geom("agent").id]], RenderSettings())
    colours = {name: model.geom_rgba[given.geom(name).id] for name in ("wall", "goal", "cloth", "agent")}
    wanted = {"wall": rgba(POST_COLOUR), "goal": (1, 0, 0, 1), "cloth": (0, 1, 0, 1), "agent": rgba(AGENT_COLOURS[0])}
    for name, colour in wanted.items():
        np.testing.assert_allclose(colours[name], colour, rtol=1e-6, err_msg=name)


def test_objects_keep_their_transparency() -> None:
    model = load_model("CatchOver2Underarm")
    goal = model.geom_bodyid == model.body("goal").id
    styled = styled_model(model, agent_geoms("CatchOver2Underarm"), RenderSettings())
    np.testing.assert_array_equal(styled.geom_rgba[goal], model.geom_rgba[goal])
    assert styled.geom_rgba[goal, 3] < 1
