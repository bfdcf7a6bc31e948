"""Direction and size of the view, for robots of every kind."""

import numpy as np
import pytest

from mapt.rendering.camera import CLIP_VIEW, BodyKinematics, Framing, ViewKind, camera_axes, frame_body
from mapt.tasks import load_model

ASPECT = 4 / 3


def framing_of(task: str) -> Framing:
    return frame_body(BodyKinematics(load_model(task)), ASPECT)


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
def test_camera_faces_the_plane_of_motion(task: str, kind: ViewKind, follows: bool) -> None:
    framing = framing_of(task)
    assert (framing.kind, framing.follows) == (kind, follows)
    assert framing.view.half_width == pytest.approx(framing.view.half_height * ASPECT)


@pytest.mark.parametrize("task", ["HalfCheetah-6x1", "Ant-4x2", "Humanoid-9|8", "Swimmer-2x1", "ManySegmentAnt-3x1"])
def test_robot_in_default_pose_fills_at_least_half_the_view(task: str) -> None:
    body = BodyKinematics(load_model(task))
    framing = frame_body(body, ASPECT)
    lowest, highest = body.extents(body.model.qpos0[None], framing.axes)
    width, height, _ = (highest - lowest)[0] / 2
    assert 0.5 < max(width / framing.view.half_width, height / framing.view.half_height) < 1.0


@pytest.mark.parametrize(("task", "square_metres"), [("HalfCheetah-6x1", 0.5), ("Reacher-2x1", 0.1)])
def test_squares_scale_with_the_robot(task: str, square_metres: float) -> None:
    assert framing_of(task).square_metres == square_metres


def test_framing_is_deterministic() -> None:
    assert framing_of("Ant-4x2").view == framing_of("Ant-4x2").view


def test_camera_axes_are_orthonormal_with_x_to_the_right() -> None:
    axes = camera_axes(28.0)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(axes[0], [1, 0, 0])
    assert axes[1, 2] > 0  # up in the image is up in the world
    assert axes[2, 2] < 0  # and the camera looks down


@pytest.mark.parametrize("task", ["HalfCheetah-6x1", "Ant-4x2", "Swimmer-2x1", "CoupledHalfCheetah-1p1"])
def test_a_body_fits_the_same_view_in_any_orientation(task: str) -> None:
    body = BodyKinematics(load_model(task))
    framing = frame_body(body, ASPECT)
    poses = body.sample_orientations(body.sample_poses()[::-1])  # other combinations than `frame_body` samples
    lowest, highest = body.geom_extents(poses, framing.axes)
    middle = (lowest.min(axis=1) + highest.max(axis=1)) / 2
    corners = framing.in_perspective(lowest, highest, middle)
    assert 0.8 < framing.excess(*corners) < 1.05
    assert framing.zoomed_out_for(*corners) is framing


def test_view_doubles_when_parts_move_apart() -> None:
    framing = framing_of("CoupledHalfCheetah-1p1")
    reach = 1.3 * framing.view.half_width
    seen = framing.zoomed_out_for(np.array([[-reach, 0.0]]), np.array([[reach, 0.5]]))
    assert seen.view.half_width == 2 * framing.view.half_width
    assert seen.distance == pytest.approx(2 * framing.distance)


def test_parts_nearer_to_the_camera_are_larger() -> None:
    framing = framing_of("Ant-4x2")
    lowest = np.array([[[-1.0, -0.5, -1.0], [-1.0, -0.2, 1.0]]])
    highest = np.array([[[0.0, 0.5, 0.0], [1.0, 0.2, 2.0]]])
    low, high = framing.in_perspective(lowest, highest, np.zeros((1, 3)))
    scale = framing.distance / (framing.distance - 1.0)
    np.testing.assert_allclose((low[0], high[0]), ((-scale, -0.5 * scale), (1.0, 0.5 * scale)))


@pytest.mark.parametrize("task", ["CatchOver2Underarm", "DoorOpenInward"])
def test_model_chooses_its_view(task: str) -> None:
    model = load_model(task)
    x, y, z, height, azimuth, look_down = model.numeric(CLIP_VIEW).data
    framing = framing_of(task)
    assert framing.fixed
    np.testing.assert_array_equal(framing.centre, [x, y, z])
    assert (2 * framing.view.half_height, framing.azimuth_degrees, framing.look_down_degrees) == (
        pytest.approx(height),
        azimuth,
        look_down,
    )
    for axes in (framing.axes, camera_axes(40.0, 230.0)):
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert axes[1, 2] > 0
        assert axes[2, 2] < 0
    # MuJoCo's camera looks along its azimuth.
    away = framing.axes[2]
    assert np.degrees(np.arctan2(away[1], away[0])) % 360 == pytest.approx(azimuth)


def test_other_cameras_see_the_same_place_from_other_angles() -> None:
    body = BodyKinematics(load_model("CatchOver2Underarm"))
    follow, side, top = (frame_body(body, ASPECT, camera) for camera in ("follow", "side", "top"))
    assert follow.view == side.view == top.view
    assert side.azimuth_degrees != follow.azimuth_degrees
    assert top.look_down_degrees > 80
