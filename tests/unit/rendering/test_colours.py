"""The palette: people can distinguish the agents, with any colour vision."""

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from mapt.rendering.appearance import (
    AGENT_COLOURS,
    BACKDROP_COLOUR,
    BODY_COLOUR,
    FLOOR_COLOURS,
    POST_COLOUR,
    START_COLOUR,
    agent_colour,
    rgb_bytes,
    rgba,
)

#: linear RGB as seen without one kind of cone (Machado, Oliveira and Fernandes 2009, severity 1)
COLOUR_VISION = {
    "trichromat": np.eye(3),
    "protanope": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranope": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanope": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
#: sRGB to XYZ, each row over the white point, D65
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
#: adjacent parts of six agents with one joint each
NEIGHBOURS = ((0, 1), (1, 2), (3, 4), (4, 5))


def lab(colour: str, vision: str = "trichromat") -> NDArray:
    """CIELAB of `#RRGGBB` as seen with this colour vision."""
    encoded = np.array(rgb_bytes(colour)) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    ratio = TO_XYZ @ np.clip(COLOUR_VISION[vision] @ linear, 0, 1) / TO_XYZ.sum(axis=1)
    x, y, z = np.where(ratio > 0.008856, np.cbrt(ratio), 7.787 * ratio + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("vision", COLOUR_VISION)
def test_six_agents_differ_with_every_colour_vision(vision: str) -> None:
    distances = [np.linalg.norm(lab(a, vision) - lab(b, vision)) for a, b in combinations(AGENT_COLOURS[:6], 2)]
    assert min(distances) > 15  # 2.3 is just noticeable side by side


def test_neighbours_in_a_leg_differ_in_lightness() -> None:
    for one, other in NEIGHBOURS:
        assert abs(lab(AGENT_COLOURS[one])[0] - lab(AGENT_COLOURS[other])[0]) > 20


def test_every_agent_is_lighter_than_the_background() -> None:
    background = max(lab(colour)[0] for colour in (BACKDROP_COLOUR, *FLOOR_COLOURS))
    assert min(lab(colour)[0] for colour in AGENT_COLOURS) > background + 10


def test_start_line_and_posts_are_darker_than_the_body() -> None:
    assert max(lab(colour)[0] for colour in (START_COLOUR, POST_COLOUR)) < lab(BODY_COLOUR)[0] - 10


def test_palette_colours_are_unique() -> None:
    assert len(set(AGENT_COLOURS)) == len(AGENT_COLOURS) >= 6


def test_colours_repeat_in_larger_teams() -> None:
    assert agent_colour(len(AGENT_COLOURS) + 1) == AGENT_COLOURS[1]


def test_rgba_converts_hexadecimal_colours() -> None:
    assert rgba("#FF8000") == (1.0, 128 / 255, 0.0, 1.0)
