"""The path of the camera."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapt.rendering.camera import View, camera_path, smooth

VIEW = View(half_width=1.3, half_height=1.0)
#: height in metres of the camera's target
HEIGHT = 0.6
WINDOW = 8

#: speeds to 20 m/s at 20 Hz: a metre a frame; bodies up to 2 m long and 1.6 m high
bodies = st.lists(st.tuples(st.floats(-1, 1), st.floats(0, 3), st.floats(0, 2), st.floats(0, 1.6)), min_size=1)


def boxes(motion: list[tuple[float, float, float, float]]) -> tuple[NDArray, NDArray]:
    """Corners (T,2) of a body that moves by the given strides."""
    stride, floor, length, height = np.array(motion).T
    lowest = np.column_stack([np.cumsum(stride), floor])
    return lowest, lowest + np.column_stack([length, height])


def steady_run(metres_a_frame: float, steps: int = 60) -> tuple[NDArray, NDArray]:
    lowest = np.column_stack([np.arange(steps) * metres_a_frame, np.zeros(steps)])
    return lowest, lowest + np.array([1.4, 0.9])


def follow(lowest: NDArray, highest: NDArray) -> NDArray:
    """The path of a camera that follows the body at a constant height."""
    along = smooth((lowest + highest)[:, 0] / 2, WINDOW)
    return camera_path(lowest, highest, np.column_stack([along, np.full(len(along), HEIGHT)]), VIEW, WINDOW)


@given(bodies)
def test_whole_body_stays_in_view_for_any_motion(motion: list[tuple[float, float, float, float]]) -> None:
    lowest, highest = boxes(motion)
    path = follow(lowest, highest)
    half = np.array([VIEW.half_width, VIEW.half_height])
    assert (lowest >= path - half - 1e-9).all()
    assert (highest <= path + half + 1e-9).all()


def test_body_larger_than_the_view_is_centred() -> None:
    lowest, highest = np.array([[0.0, 0.0]]), np.array([[9.0, 5.0]])
    np.testing.assert_allclose(follow(lowest, highest), [[4.5, 2.5]])


def test_constant_velocity_is_followed_exactly_to_both_ends() -> None:
    lowest, highest = steady_run(0.25)
    path = follow(lowest, highest)
    np.testing.assert_allclose(path[:, 0], (lowest + highest)[:, 0] / 2, atol=1e-9)


def test_height_is_constant_while_the_body_fits() -> None:
    lowest, highest = steady_run(0.25)
    bounce = 0.3 * np.sin(np.arange(len(lowest)))
    lowest[:, 1] += bounce
    highest[:, 1] += bounce
    np.testing.assert_array_equal(follow(lowest, highest)[:, 1], HEIGHT)


def test_camera_moves_more_smoothly_than_a_jolting_body() -> None:
    lowest, highest = steady_run(0.15)
    jolt = 0.1 * np.sin(np.arange(len(lowest)) * 2 * np.pi / 8)[:, None] * [1, 0]
    path = follow(lowest + jolt, highest + jolt)[:, 0]
    body = ((lowest + highest) / 2 + jolt)[:, 0]
    assert np.abs(np.diff(path, 2)).max() < 0.2 * np.abs(np.diff(body, 2)).max()


def test_camera_rises_smoothly_before_a_leap() -> None:
    lowest, highest = steady_run(0.1)
    flight = np.linspace(0, 1, 18)
    leap = 0.9 * 4 * flight * (1 - flight)  # metres: 0.9 s in the air
    lowest[20:38, 1] += leap
    highest[20:38, 1] += leap
    height = follow(lowest, highest)[:, 1]
    leaves_view = np.flatnonzero(highest[:, 1] > HEIGHT + VIEW.half_height)[0]
    assert height[leaves_view - 4] > HEIGHT
    assert np.abs(np.diff(height)).max() < 0.2 * (height.max() - HEIGHT)
