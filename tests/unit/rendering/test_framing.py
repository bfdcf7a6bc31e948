"""From which side, and how much, the camera sees of bodies of every kind."""

import numpy as np
import pytest

from mapt.rendering.camera import Body, Framing, Kind, directions, frame
from mapt.tasks import load_model

ASPECT = 4 / 3


def framing_of(task: str) -> Framing:
    return frame(Body(load_model(task)), ASPECT)


@pytest.mark.parametrize(
    ("task", "kind", "follows"),
    [
        ("HalfCheetah-6x1", "side", True),
        ("Hopper-3x1", "side", True),
        ("Walker2d-2x3", "side", True),
        ("CoupledHalfCheetah-1p1", "slanted", True),
        ("Ant-4x2", "slanted", True),
        ("Humanoid-9|8", "slanted", True),
        ("ManySegmentAnt-3x1", "slanted", True),
        ("Swimmer-2x1", "above", True),
        ("ManySegmentSwimmer-10x2", "above", True),
        ("Reacher-2x1", "above", False),
        ("Pusher-3p", "slanted", False),
    ],
)
def test_the_camera_looks_at_the_plane_in_which_a_body_moves(task: str, kind: Kind, follows: bool) -> None:
    framing = framing_of(task)
    assert (framing.kind, framing.follows) == (kind, follows)
    assert framing.view.half_width == pytest.approx(framing.view.half_height * ASPECT)


@pytest.mark.parametrize("task", ["HalfCheetah-6x1", "Ant-4x2", "Humanoid-9|8", "Swimmer-2x1", "ManySegmentAnt-3x1"])
def test_a_standing_body_fills_half_of_the_view_or_more(task: str) -> None:
    body = Body(load_model(task))
    framing = frame(body, ASPECT)
    lowest, highest = body.extents(body.model.qpos0[None], framing.axes)
    width, height, _ = (highest - lowest)[0] / 2
    assert 0.5 < max(width / framing.view.half_width, height / framing.view.half_height) < 1.0


@pytest.mark.parametrize(("task", "square_metres"), [("HalfCheetah-6x1", 0.5), ("Reacher-2x1", 0.1)])
def test_squares_suit_the_size_of_the_body(task: str, square_metres: float) -> None:
    assert framing_of(task).square_metres == square_metres


def test_framing_a_model_again_gives_the_same_view() -> None:
    assert framing_of("Ant-4x2").view == framing_of("Ant-4x2").view


def test_directions_are_at_right_angles_and_see_x_to_the_right() -> None:
    axes = directions(28.0)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(axes[0], [1, 0, 0])
    assert axes[1, 2] > 0  # up in the picture is up in the world
    assert axes[2, 2] < 0  # and the camera looks down


def test_a_body_that_has_spread_out_is_seen_from_farther_away() -> None:
    framing = framing_of("CoupledHalfCheetah-1p1")
    reach = 2.0 * framing.view.half_width
    seen = framing.fitting(np.array([[-reach, 0.0]]), np.array([[reach, 0.5]]))
    assert seen.view.half_width > reach
    assert seen.distance / framing.distance == pytest.approx(seen.view.half_width / framing.view.half_width)
    assert framing.fitting(np.zeros((1, 2)), np.full((1, 2), 0.1)) is framing


def test_what_is_nearer_to_the_camera_takes_more_room() -> None:
    framing = framing_of("Ant-4x2")
    lowest, highest, middle = np.array([[-1.0, -0.5, -1.0]]), np.array([[1.0, 0.5, 1.0]]), np.zeros((1, 3))
    low, high = framing.in_perspective(lowest, highest, middle)
    scale = framing.distance / (framing.distance - 1.0)
    np.testing.assert_allclose((low[0, 0], high[0, 0]), (-scale, scale))
