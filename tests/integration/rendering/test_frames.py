"""Frames of HalfCheetah: reproducibility, colours, view and floor."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from integration.rendering.drawing import Drawing
from integration.rendering.gaits import trot, wild_run
from mapt.rendering.appearance import AGENT_COLOURS, rgb_bytes
from mapt.rendering.settings import Quality, RenderSettings
from mapt.tasks import agent_geoms

#: without anti-aliasing, which mixes colours at edges
SMALL = RenderSettings(width=320, height=240, quality="fast")
SIX = [list(geoms) for geoms in agent_geoms("HalfCheetah-6x1")]
TWO = [list(geoms) for geoms in agent_geoms("HalfCheetah-2x3")]
#: torso and head as a seventh agent, so that every part of the body has an agent's colour
WHOLE_BODY = [*SIX, [1, 2]]


def pixels_of(agent: int, frames: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(T,H,W): pixels with the colour of this agent, fully lit or darker."""
    colour = np.array(rgb_bytes(AGENT_COLOURS[agent]), dtype=float)
    shade = np.clip((frames @ colour) / (colour @ colour), 0.6, 1.05)
    return np.abs(frames - shade[..., None] * colour).max(axis=-1) < 10


def count_of(agent: int, frames: NDArray[np.uint8]) -> NDArray[np.int64]:
    """(T,): number of pixels with the colour of this agent."""
    return pixels_of(agent, frames).sum(axis=(1, 2))


@pytest.mark.slow
def test_two_processes_render_the_same_bytes(drawing: Drawing) -> None:
    first = drawing.frames(trot(6), SIX, SMALL)
    drawing.close()
    second = drawing.frames(trot(6), SIX, SMALL)
    assert first.shape == (6, 240, 320, 3)
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("quality", ["fast", "smooth", "pretty"])
def test_each_of_six_agents_is_visible_in_its_colour(drawing: Drawing, quality: Quality) -> None:
    frames = drawing.frames(trot(10), SIX, RenderSettings(width=320, height=240, quality=quality))
    for agent in range(6):
        assert count_of(agent, frames).min() > 60, AGENT_COLOURS[agent]
    assert count_of(6, frames).max() == 0


def test_smooth_edges_have_intermediate_colours(drawing: Drawing) -> None:
    fast, smooth = (
        drawing.frames(trot(1), WHOLE_BODY, replace(SMALL, quality=quality)) for quality in ("fast", "smooth")
    )
    exact = [np.any([pixels_of(agent, frames) for agent in range(7)], axis=0) for frames in (fast, smooth)]
    # Pixels on an edge of the body have the body's colour or the floor's; with anti-aliasing, a mixture.
    mixed = exact[0] & ~exact[1]
    assert 100 < mixed.sum() < 0.4 * exact[0].sum()


def test_two_agents_of_three_joints_have_two_colours(drawing: Drawing) -> None:
    frames = drawing.frames(trot(10), TWO, SMALL)
    assert count_of(0, frames).min() > 400
    assert count_of(1, frames).min() > 400
    assert all(count_of(agent, frames).max() == 0 for agent in range(2, 7))


def test_colour_moves_with_the_limb_of_its_agent(drawing: Drawing) -> None:
    still = np.zeros((2, 9))
    still[1, 8] = 0.5  # only the front foot, agent 5
    frames = drawing.frames(still, SIX, SMALL)
    changed = [int((pixels[0] ^ pixels[1]).sum()) for pixels in (pixels_of(agent, frames) for agent in range(6))]
    # The camera moves by a fraction of a pixel, because the body's extent has changed.
    assert max(changed[:4]) < 0.05 * changed[5]
    assert changed[5] > 5 * changed[4]  # a little more or less of the shin is visible at the joint


@pytest.mark.slow
def test_whole_body_stays_in_view_during_a_wild_run(drawing: Drawing) -> None:
    frames = drawing.frames(wild_run(60), WHOLE_BODY, SMALL)
    shown = np.any([pixels_of(agent, frames) for agent in range(7)], axis=0)
    edge = np.concatenate(
        [shown[:, :2].ravel(), shown[:, -2:].ravel(), shown[:, :, :2].ravel(), shown[:, :, -2:].ravel()]
    )
    assert not edge.any()
    assert shown.sum(axis=(1, 2)).min() > 3000


def test_floor_moves_with_the_speed(drawing: Drawing) -> None:
    standing = np.repeat(trot(1), 4, axis=0)
    running = standing.copy()
    running[:, 0] = 0.2 * np.arange(4)
    ground = (slice(None), slice(200, 240))
    still, moving = (drawing.frames(qpos, SIX, SMALL)[ground].astype(int) for qpos in (standing, running))
    assert np.abs(np.diff(still, axis=0)).max() == 0
    assert (np.abs(np.diff(moving, axis=0)).max(axis=-1) > 10).mean() > 0.1
