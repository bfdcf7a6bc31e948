"""The colours of a clip.

Agents take the colours of Okabe and Ito's palette, which people with any of the common colour-vision
deficiencies can tell apart, ordered so that neighbours in a leg differ in lightness as well as in hue. The legend of
the page shows the same strings.
"""

#: colour of agent n is AGENT_COLOURS[n % 8]
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

#: parts that no agent moves: the torso, the head
BODY_COLOUR = "#AEB4BB"
BACKDROP_COLOUR = "#252C36"
FLOOR_COLOURS = ("#303945", "#48535F")
SHADOW_COLOUR = "#14191F"
#: posts at every metre, and the line where the clip began
POST_COLOUR = "#717D8A"
START_COLOUR = "#E8ECF0"


def agent_colour(agent: int) -> str:
    """The colour of one agent, as `#RRGGBB`. Teams larger than the palette go round again."""
    return AGENT_COLOURS[agent % len(AGENT_COLOURS)]


def rgb_bytes(colour: str) -> tuple[int, int, int]:
    """`#RRGGBB` as three numbers from 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def rgba(colour: str) -> tuple[float, float, float, float]:
    """`#RRGGBB` as MuJoCo wants it: four numbers from 0 to 1, opaque."""
    red, green, blue = rgb_bytes(colour)
    return red / 255, green / 255, blue / 255, 1.0
