"""What a match looks like: the pitch from above, with the opponents' goal on the right.

Agents' players are round, in the colours and with the numbers of the page's legend; their teammates, whom the engine
controls, are white; opponents are red diamonds. A ring marks the player who owns the ball, lines where players run.
The ball leaves a trail, has a line to where it is in the next step, and a shadow when it is in the air. Chevrons point
to the goal that the agents attack; a goal in which the ball lies is yellow. The board has the goals of both teams and
the seconds since the match began.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.canvas import Canvas, Colour
from mapt.tasks.football.match import OURS, THEIRS, Match
from mapt.tasks.football.scenarios import STEPS_PER_SECOND, Scenario

#: metres per unit of the engine's x and y
METRES = np.array([54.4, 83.6])
#: half the length and the width of the pitch, and of a goal's width, in metres; its depth
_HALF_LENGTH, _HALF_WIDTH, _HALF_GOAL, _GOAL_DEPTH = 55.0, 36.0, 3.7, 2.5
#: depth and half the width of the penalty areas and of the goal areas, in metres
_AREAS = ((16.5, 20.15), (5.5, 9.15))
_CIRCLE = 9.15

_GRASS, _STRIPE, _LINE, _AROUND = (58, 118, 70), (64, 126, 76), (205, 222, 208), (40, 84, 52)
_NET, _INSIDE, _CHEVRON = (236, 240, 238), (110, 120, 116), (150, 196, 158)
_AGENT_EDGE, _TEAMMATE, _TEAMMATE_EDGE = (16, 20, 26), (240, 242, 245), (92, 100, 112)
_OPPONENT, _OPPONENT_EDGE = (176, 30, 44), (255, 168, 160)
_BALL, _BALL_EDGE, _SHADOW, _OWNER = (255, 255, 255), (10, 12, 16), (22, 48, 30), (255, 236, 110)
_BOARD, _INK, _BOARD_INK = (20, 24, 30), (14, 16, 20), (240, 244, 248)

#: metres around what a clip shows, and the least length that is shown
_MARGIN, _LEAST_LENGTH = 5.0, 46.0
#: distance in metres from the ball beyond which agents may be out of view
_FAR = 35.0
#: radius of a player and of the ball, and the height of the board, as shares of the image's height
_PLAYER, _BALL_RADIUS, _BOARD_SHARE = 1 / 38, 1 / 80, 1 / 12
#: steps that the line in front of a player is long
_AHEAD_STEPS = 6
#: steps of the ball's trail
_TRAIL_STEPS = 8


@dataclass(frozen=True, slots=True)
class _View:
    """The part of the pitch that a clip shows. It does not move, so that motion is visible."""

    #: pixels per metre
    scale: float
    #: metres along x and y of the upper left corner of the image
    left: float
    top: float

    @classmethod
    def of(cls, points: NDArray[np.float64], height: float, width: float, board: float) -> "_View":
        """The view of these points (K, 2) in metres, and of the goal on the right, below a board (all in pixels)."""
        right = _HALF_LENGTH + _GOAL_DEPTH + 1.5
        widest = right + _HALF_LENGTH + _GOAL_DEPTH + 1.5
        tall = 2 * (np.abs(points[:, 1]).max() + _MARGIN) * width / (height - board)
        length = float(np.clip(max(right - points[:, 0].min() + _MARGIN, tall), _LEAST_LENGTH, widest))
        scale = width / length
        return cls(scale, right - length, -(height + board) / scale / 2)

    def pixels(self, metres: NDArray[np.float64]) -> NDArray[np.float64]:
        """Columns and rows (..., 2) of points (..., 2)."""
        return (metres - (self.left, self.top)) * self.scale


class FootballDrawing:
    """A `Drawing` of one scenario."""

    version = 1
    #: as fast as the match
    frame_rate_hz = float(STEPS_PER_SECOND)

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario

    def frames(
        self, states: NDArray[np.float64], height: int, width: int, agent_colours: Sequence[Colour]
    ) -> Iterator[NDArray[np.uint8]]:
        """See `Drawing.frames`."""
        match = Match.of(states, self._scenario)
        ball = match.ball[:, None, :2] * METRES
        agents = match.of_agents(match.team.position) * METRES
        taking_part = agents[np.linalg.norm(agents - ball, axis=2) < _FAR]
        view = _View.of(np.concatenate([ball[:, 0], taking_part]), height, width, _BOARD_SHARE * height)
        pitch = Canvas(height, width, _AROUND)
        _draw_pitch(pitch, view)
        for step in range(len(states)):
            canvas = pitch.copy()
            for side, goals in ((1, match.goals[step, 0]), (-1, match.goals[step, 1])):
                if goals:
                    _draw_goal(canvas, view, side, _OWNER)
            self._draw_players(canvas, match, step, view, agent_colours)
            _draw_ball(canvas, match, step, view)
            _draw_board(canvas, match, step)
            yield canvas.image()

    def _draw_players(
        self, canvas: Canvas, match: Match, step: int, view: _View, agent_colours: Sequence[Colour]
    ) -> None:
        radius = canvas.height * _PLAYER
        controlled = match.controlled[step].tolist()
        for team, side in ((match.opponents, THEIRS), (match.team, OURS)):
            places = view.pixels(team.position[step] * METRES)
            ahead = view.pixels((team.position[step] + _AHEAD_STEPS * team.velocity[step]) * METRES)
            # Agents come last, above the others of their team.
            order = sorted(np.flatnonzero(team.present[step]).tolist(), key=lambda player: player in controlled)
            for player in order:
                x, y = places[player].tolist()
                if match.owner_team[step] == side and match.owner[step] == player:
                    canvas.disc(x, y, 1.75 * radius, _OWNER, opacity=0.9)
                canvas.line((x, y), tuple(ahead[player].tolist()), 0.4 * radius, _INK, opacity=0.55)
                if side == THEIRS:
                    canvas.diamond(x, y, 1.5 * radius, _OPPONENT_EDGE)
                    canvas.diamond(x, y, 1.15 * radius, _OPPONENT)
                elif player in controlled:
                    agent = controlled.index(player)
                    canvas.disc(x, y, 1.3 * radius, _AGENT_EDGE)
                    canvas.disc(x, y, 1.15 * radius, agent_colours[agent])
                    canvas.number(agent + 1, x, y, 1.2 * radius, _INK)
                else:
                    canvas.disc(x, y, 0.95 * radius, _TEAMMATE_EDGE)
                    canvas.disc(x, y, 0.75 * radius, _TEAMMATE)


def _draw_ball(canvas: Canvas, match: Match, step: int, view: _View) -> None:
    first = max(0, step - _TRAIL_STEPS)
    trail = view.pixels(match.ball[first : step + 1, :2] * METRES)
    radius = canvas.height * _BALL_RADIUS
    for place, (start, end) in enumerate(pairwise(trail)):
        # A jump is the start of another match.
        if np.abs(end - start).max() < 0.2 * canvas.width:
            share = (place + first - step + _TRAIL_STEPS + 1) / _TRAIL_STEPS
            canvas.line(tuple(start.tolist()), tuple(end.tolist()), 1.1 * radius, _BALL, opacity=0.55 * share)
    x, y = trail[-1].tolist()
    ahead = view.pixels((match.ball[step, :2] + match.ball_velocity[step, :2]) * METRES)
    canvas.line((x, y), tuple(ahead.tolist()), 0.5 * radius, _BALL, opacity=0.8)
    lifted = 0.6 * view.scale * float(match.ball[step, 2])
    if lifted > radius:
        canvas.disc(x, y, radius, _SHADOW, opacity=0.7)
    canvas.disc(x, y - lifted, radius + 1.5, _BALL_EDGE)
    canvas.disc(x, y - lifted, radius, _BALL)


def _draw_board(canvas: Canvas, match: Match, step: int) -> None:
    """The goals of our team, white, and of the opponents, red, and the seconds since the start beside a clock."""
    height = _BOARD_SHARE * canvas.height
    middle, y, digit = canvas.width / 2, 0.5 * height, 0.6 * height
    canvas.rectangle(0, 0, canvas.width, height, _BOARD)
    ours, theirs = match.goals[step].astype(int).tolist()
    canvas.disc(middle - 1.9 * height, y, 0.3 * height, _TEAMMATE)
    canvas.number(ours, middle - 1.1 * height, y, digit, _BOARD_INK)
    for dot in (-0.15, 0.15):
        canvas.disc(middle - 0.4 * height, y + dot * height, 0.07 * height, _BOARD_INK)
    canvas.number(theirs, middle + 0.3 * height, y, digit, _BOARD_INK)
    canvas.diamond(middle + 1.1 * height, y, 0.4 * height, _OPPONENT_EDGE)
    canvas.diamond(middle + 1.1 * height, y, 0.3 * height, _OPPONENT)
    clock, hand = canvas.width - 2.2 * height, 0.2 * height
    canvas.disc(clock, y, 0.32 * height, _BOARD_INK)
    canvas.disc(clock, y, 0.26 * height, _BOARD)
    for end in ((clock, y - hand), (clock + hand, y)):
        canvas.line((clock, y), end, 0.07 * height, _BOARD_INK)
    canvas.number(int(match.elapsed_steps[step]) // STEPS_PER_SECOND, clock + height, y, digit, _BOARD_INK)


def _draw_pitch(canvas: Canvas, view: _View) -> None:
    """The grass, its lines, the goals, and chevrons that point to the opponents' goal."""
    thick = max(1.0, 0.25 * view.scale)

    def rectangle(left: float, top: float, right: float, bottom: float, colour: Colour) -> None:
        (x0, y0), (x1, y1) = view.pixels(np.array([[left, top], [right, bottom]])).tolist()
        canvas.rectangle(x0, y0, x1 - x0, y1 - y0, colour)

    def line(points: Sequence[tuple[float, float]], width: float, colour: Colour, opacity: float = 1.0) -> None:
        pixels = [tuple(point) for point in view.pixels(np.array(points)).tolist()]
        for start, end in pairwise(pixels):
            canvas.line(start, end, width, colour, opacity)

    for stripe in range(20):
        left = -_HALF_LENGTH + 5.5 * stripe
        rectangle(left, -_HALF_WIDTH, left + 5.5, _HALF_WIDTH, _STRIPE if stripe % 2 else _GRASS)
    for x in (-4.0, 8.0, 20.0, 32.0):
        line([(x, -5.0), (x + 4.0, 0.0), (x, 5.0)], 1.1 * view.scale, _CHEVRON, opacity=0.5)
    line(_box(-_HALF_LENGTH, _HALF_LENGTH, _HALF_WIDTH), thick, _LINE)
    line([(0.0, -_HALF_WIDTH), (0.0, _HALF_WIDTH)], thick, _LINE)
    angles = np.linspace(0, 2 * np.pi, 41)
    line([(_CIRCLE * float(np.cos(a)), _CIRCLE * float(np.sin(a))) for a in angles], thick, _LINE)
    for side in (-1, 1):
        for depth, half in _AREAS:
            line(_box(side * _HALF_LENGTH, side * (_HALF_LENGTH - depth), half), thick, _LINE)
        _draw_goal(canvas, view, side, _INSIDE)


def _draw_goal(canvas: Canvas, view: _View, side: int, inside: Colour) -> None:
    """The goal on the right (1) or left (-1), seen from above."""
    corners = _box(side * _HALF_LENGTH, side * (_HALF_LENGTH + _GOAL_DEPTH), _HALF_GOAL)
    places = view.pixels(np.array(corners))
    (left, top), (right, bottom) = places.min(axis=0).tolist(), places.max(axis=0).tolist()
    canvas.rectangle(left, top, right - left, bottom - top, inside)
    for start, end in pairwise(places.tolist()):
        canvas.line(tuple(start), tuple(end), 2.2 * max(1.0, 0.25 * view.scale), _NET)


def _box(x0: float, x1: float, half: float) -> list[tuple[float, float]]:
    return [(x0, -half), (x1, -half), (x1, half), (x0, half), (x0, -half)]
