"""What a skirmish looks like: the battlefield from above, between the lists of both armies.

Agents are round, in the colours and with the numbers of the page's legend; a dark ring marks a repeated colour, which
has stripes in the legend. Enemies are red diamonds. Bars above a unit show its shield (blue) and its health (green).
Lines show who hit whom in the last step: white those of agents, red those of enemies, green ones heal. The ground is
lighter where a living agent sees. A cross marks a dead unit.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.canvas import Canvas, Colour
from mapt.tasks.skirmish.maps import MAP_SIZE, SIGHT_RANGE, SkirmishMap, UnitType

#: numbers of one unit in a state: x, y, health, shield, and the unit that it hit or healed in the last step, or -1
DRAWN_NUMBERS = 5

_OUTSIDE, _UNSEEN, _SEEN, _GRID = (27, 31, 38), (43, 50, 60), (66, 76, 89), (56, 65, 77)
_AGENT_EDGE, _ENEMY, _ENEMY_EDGE = (245, 247, 250), (150, 32, 40), (255, 122, 112)
_AGENT_SHOT, _ENEMY_SHOT, _HEALING = (255, 250, 205), (255, 92, 70), (105, 240, 140)
_HEALTH, _WEAK, _SHIELD, _EMPTY, _DEAD = (92, 214, 92), (240, 180, 60), (110, 180, 255), (16, 18, 22), (110, 118, 130)
_INK = (15, 17, 20)
#: map units between two lines of the grid
_GRID_STEP = 4
#: side in map units of the part of the map that is shown, unless a clip's units need more
_VIEW = 20.0
#: map units between a unit and the edge of the view
_MARGIN = 2.0
#: share of health below which its bar changes colour
_WEAK_SHARE = 0.4


@dataclass(frozen=True, slots=True)
class _View:
    """The square part of the map that a clip shows, in the middle of an image."""

    #: pixels per map unit, and the first column and row of the square
    scale: float
    left: float
    top: float
    #: the lowest x and the highest y of the map that are shown
    west: float
    north: float

    @classmethod
    def of(cls, units: NDArray[np.float64], height: int, width: int) -> "_View":
        """The view of all living units (T, U, 5) of a clip. It does not move, so that the units' motion is visible."""
        alive = units[units[:, :, 2] > 0][:, :2]
        low, high = (alive.min(axis=0), alive.max(axis=0)) if len(alive) else (np.zeros(2), np.full(2, MAP_SIZE))
        side = float(min(max(_VIEW, (high - low).max() + 2 * _MARGIN), MAP_SIZE))
        west, south = np.clip((low + high - side) / 2, 0, MAP_SIZE - side).tolist()
        scale = min(height, width) / side
        return cls(scale, (width - scale * side) / 2, (height - scale * side) / 2, west, south + side)

    def pixels(self, units: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Columns and rows of units (U, 5). North is up."""
        return self.left + self.scale * (units[:, 0] - self.west), self.top + self.scale * (self.north - units[:, 1])


class SkirmishDrawing:
    """A `Drawing` of one map."""

    version = 3
    #: three times as fast as the battle: at 2.8 steps per second, fifty steps would take 18 s
    frame_rate_hz = 8.0

    def __init__(self, battle_map: SkirmishMap) -> None:
        self._units = battle_map.units
        self._n = len(battle_map.agents)

    def frames(
        self, states: NDArray[np.float64], height: int, width: int, agent_colours: Sequence[Colour]
    ) -> Iterator[NDArray[np.uint8]]:
        """See `Drawing.frames`."""
        units = states.reshape(len(states), len(self._units), DRAWN_NUMBERS)
        view = _View.of(units, height, width)
        for each in units:
            yield self._frame(Canvas(height, width, _UNSEEN), each, view, agent_colours)

    def _frame(
        self, canvas: Canvas, units: NDArray[np.float64], view: _View, agent_colours: Sequence[Colour]
    ) -> NDArray[np.uint8]:
        scale = view.scale
        x, y = view.pixels(units)
        alive = units[:, 2] > 0
        seeing = np.flatnonzero(alive[: self._n])
        _draw_ground(canvas, view, x[seeing], y[seeing])
        for number in np.flatnonzero(~alive).tolist():
            _draw_cross(canvas, x[number], y[number], 0.25 * scale)
        # Agents above enemies, whom labellers need not tell apart. Those who fly are below both: they are larger and
        # stay over other units, which would be hidden.
        order = sorted(
            np.flatnonzero(alive).tolist(), key=lambda number: (not self._units[number].flies, number < self._n)
        )
        for number in order:
            self._draw_unit(canvas, number, (x[number], y[number]), scale, agent_colours)
        for number in np.flatnonzero(units[:, 4] >= 0).tolist():
            hit = int(units[number, 4])
            self._draw_hit(canvas, number, (x[number], y[number]), (x[hit], y[hit]), scale)
        for number in order:
            kind = self._units[number]
            corner = x[number] - 0.45 * scale, y[number] - (kind.radius + 0.2) * scale
            _draw_bars(canvas, kind, units[number], corner, (0.9 * scale, 0.14 * scale))
        if view.left > 0:
            self._draw_armies(canvas, units, view.left, agent_colours)
        return canvas.image()

    def _draw_unit(
        self, canvas: Canvas, number: int, place: tuple[float, float], scale: float, agent_colours: Sequence[Colour]
    ) -> None:
        kind, (x, y) = self._units[number], place
        radius, edge = kind.radius * scale, 0.07 * scale
        if number < self._n:
            _draw_agent(canvas, number, (x, y), (radius, edge), agent_colours)
            canvas.number(number + 1, x, y, min(1.1 * radius, 0.5 * scale), _INK)
            return
        # A diamond with the area of the disc.
        canvas.diamond(x, y, 1.25 * radius + 1.4 * edge, _ENEMY_EDGE)
        canvas.diamond(x, y, 1.25 * radius, _ENEMY)
        if kind.heals:
            arm, width = 0.3 * scale, 0.2 * scale
            canvas.line((x - arm, y), (x + arm, y), width, _ENEMY_EDGE)
            canvas.line((x, y - arm), (x, y + arm), width, _ENEMY_EDGE)

    def _draw_hit(
        self, canvas: Canvas, number: int, start: tuple[float, float], end: tuple[float, float], scale: float
    ) -> None:
        colour = _AGENT_SHOT if number < self._n else _ENEMY_SHOT
        if self._units[number].heals:
            colour = _HEALING
        canvas.line(start, end, 0.09 * scale, colour, opacity=0.7)
        canvas.disc(*end, 0.17 * scale, colour, opacity=0.9)

    def _draw_armies(
        self, canvas: Canvas, units: NDArray[np.float64], margin: float, agent_colours: Sequence[Colour]
    ) -> None:
        """Beside the map, one row per unit: agents on the left, enemies on the right.

        The page writes which clip it is over the upper left corner, so the first row is below that.
        """
        canvas.rectangle(0, 0, margin, canvas.height, _OUTSIDE)
        canvas.rectangle(canvas.width - margin, 0, margin, canvas.height, _OUTSIDE)
        row = min(canvas.height / 14, margin / 2.5)
        for number, (kind, unit) in enumerate(zip(self._units, units, strict=True)):
            is_agent, alive = number < self._n, unit[2] > 0
            start = 0.0 if is_agent else canvas.width - margin
            x, y, radius = start + 0.2 * margin, row * (number - self._n * (not is_agent) + 1.6), 0.32 * row
            if is_agent:
                if alive:
                    _draw_agent(canvas, number, (x, y), (radius, 0.12 * radius), agent_colours)
                else:
                    canvas.disc(x, y, radius, _DEAD)
                canvas.number(number + 1, x, y, (1.1 if number < 9 else 0.85) * radius, _INK)
            else:
                canvas.diamond(x, y, 1.2 * radius, _ENEMY if alive else _DEAD)
            if alive:
                _draw_bars(canvas, kind, unit, (start + 0.4 * margin, y + 0.2 * row), (0.5 * margin, 0.2 * row))
            else:
                _draw_cross(canvas, start + 0.65 * margin, y, 0.2 * row)


def _draw_agent(
    canvas: Canvas,
    number: int,
    place: tuple[float, float],
    size: tuple[float, float],
    agent_colours: Sequence[Colour],
) -> None:
    """A disc in the agent's colour and its edge; in the disc, a dark ring if an agent before it has the same colour.

    Args:
        size: radius of the disc and width of the edge.
    """
    colour, (x, y), (radius, edge) = agent_colours[number], place, size
    canvas.disc(x, y, radius + edge, _AGENT_EDGE)
    if colour in agent_colours[:number]:
        canvas.disc(x, y, radius, _INK)
        radius *= 0.85
    canvas.disc(x, y, radius, colour)


def _draw_ground(canvas: Canvas, view: _View, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    """What agents at these points see of the ground, and the grid."""
    side = canvas.width - 2 * view.left
    canvas.discs(x, y, SIGHT_RANGE * view.scale, _SEEN)
    for line in range(0, int(MAP_SIZE), _GRID_STEP):
        canvas.rectangle(view.left + view.scale * (line - view.west) - 0.5, view.top, 1, side, _GRID)
        canvas.rectangle(view.left, view.top + view.scale * (view.north - line) - 0.5, side, 1, _GRID)


def _draw_bars(
    canvas: Canvas,
    kind: UnitType,
    unit: NDArray[np.float64],
    corner: tuple[float, float],
    size: tuple[float, float],
) -> None:
    """A bar of the unit's health, with its shield above it; `corner` is the lower left one of the bar of health."""
    (x, bottom), (width, height) = corner, size
    share = unit[2] / kind.health
    bars = [(share, _HEALTH if share >= _WEAK_SHARE else _WEAK)]
    if kind.shield:
        bars.append((unit[3] / kind.shield, _SHIELD))
    canvas.rectangle(x - 1, bottom - height * len(bars) - 1, width + 2, height * len(bars) + 2, _EMPTY)
    for place, (full, colour) in enumerate(bars, start=1):
        canvas.rectangle(x, bottom - height * place, width * full, height, colour)


def _draw_cross(canvas: Canvas, x: float, y: float, arm: float) -> None:
    canvas.line((x - arm, y - arm), (x + arm, y + arm), 0.5 * arm, _DEAD)
    canvas.line((x - arm, y + arm), (x + arm, y - arm), 0.5 * arm, _DEAD)
