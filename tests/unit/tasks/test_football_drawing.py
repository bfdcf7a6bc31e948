"""What a match looks like. Needs no engine: the states are stored ones."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapt.tasks import find_drawing, frame_rate_hz, task_spec
from mapt.tasks.football.match import last_states

STORED = dict(np.load(Path(__file__).parent / "stored" / "football.npz"))
#: pure colours, which nothing else has
COLOURS = [(255, 0, 255), (0, 255, 255), (255, 255, 0), (0, 0, 255)]
SIZE, BOARD = (240, 320), 20
BALL, TEAMMATE, OPPONENT, OWNER = (255, 255, 255), (240, 242, 245), (176, 30, 44), (255, 236, 110)


def states(name: str) -> NDArray[np.float64]:
    return STORED[name.replace("-", "_")].astype(np.float64)


def draw(name: str, drawn: NDArray[np.float64], size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    drawing = find_drawing(f"Football-{name}")
    assert drawing is not None
    colours = COLOURS[: task_spec(f"Football-{name}").n_agents]
    return np.stack(list(drawing.frames(drawn, *size, colours)))


def where(frame: NDArray[np.uint8], colour: tuple[int, int, int], tolerance: int = 12) -> NDArray[np.bool_]:
    return np.abs(frame.astype(int) - colour).max(axis=-1) <= tolerance


def column(frame: NDArray[np.uint8], colour: tuple[int, int, int]) -> float:
    """Mean column of a colour below the board."""
    return float(np.nonzero(where(frame[BOARD:], colour))[1].mean())


@pytest.mark.parametrize("name", ["3-vs-1", "counterattack-easy", "pass-and-shoot"])
def test_a_drawing_is_a_pure_function_of_the_states(name: str) -> None:
    given = states(name)
    kept = given.copy()
    frames = draw(name, given)
    assert frames.shape == (len(given), *SIZE, 3)
    np.testing.assert_array_equal(frames, draw(name, given))
    np.testing.assert_array_equal(given, kept)
    assert draw(name, given[:1], (480, 640)).shape == (1, 480, 640, 3)
    assert frame_rate_hz(f"Football-{name}") == 10.0


def test_agents_teammates_opponents_and_the_ball_are_told_apart() -> None:
    frame = draw("counterattack-easy", states("counterattack-easy")[:1])[0][BOARD:]
    for colour in (*COLOURS, TEAMMATE, OPPONENT):
        assert where(frame, colour).sum() > 20
    assert where(frame, BALL, 3).sum() >= 8


def test_the_attack_goes_to_the_right() -> None:
    clip = states("3-vs-1")[:-1]
    frames = draw("3-vs-1", clip)
    # The agent with the ball runs to the right, where the goal is.
    runner = COLOURS[int(np.flatnonzero(clip[0, 12 : 12 + 33 : 11] == clip[0, 7])[0])]
    assert column(frames[5], runner) > column(frames[0], runner) + 3
    assert column(frames[0], runner) > SIZE[1] / 2


def test_a_ring_marks_the_owner_of_the_ball() -> None:
    frames = draw("3-vs-1", states("3-vs-1")[:9])
    ringed = [bool(where(frame, OWNER, 30).any()) for frame in frames]
    assert ringed == [True] * 6 + [False] * 3


def test_the_board_shows_goals_and_time() -> None:
    first, later, goal = (draw("3-vs-1", states("3-vs-1")[step : step + 1])[0] for step in (0, 8, 9))
    np.testing.assert_array_equal(first[:BOARD], later[:BOARD])  # within the same second
    changed = np.abs(goal[:BOARD].astype(int) - later[:BOARD]).max(axis=(0, 2)) > 30
    columns = np.flatnonzero(changed)
    assert (columns < SIZE[1] / 2).any()  # our goals
    assert (columns > 0.75 * SIZE[1]).any()  # the next second
    assert not (changed[160:240]).any()  # theirs


def test_the_goal_in_which_the_ball_lies_is_yellow() -> None:
    clip = states("3-vs-1")
    scored = np.concatenate([clip[:-1], last_states(clip[-2:-1], clip[-1:])])
    scored[:, 6] = -1  # no ring around an owner
    *_, before, after = draw("3-vs-1", scored)
    assert not where(before, OWNER).any()
    yellow = where(after, OWNER)
    assert yellow.sum() > 50
    assert np.nonzero(yellow)[1].min() > 0.9 * SIZE[1]
    ball = np.nonzero(where(after, BALL, 3) & (np.arange(SIZE[1]) > 0.9 * SIZE[1]))
    assert yellow[ball[0].min() - 6 : ball[0].max() + 7].any()


def test_the_ball_has_a_shadow_in_the_air_and_a_trail_that_no_new_match_continues() -> None:
    flying = states("pass-and-shoot")[1:2].copy()
    flying[0, :2] = 0.5, 0.3
    ground = flying.copy()
    ground[0, 2], flying[0, 2] = 0.1, 6.0
    shadow = (22, 48, 30)
    assert (
        where(draw("pass-and-shoot", flying)[0], shadow, 25).sum()
        > where(draw("pass-and-shoot", ground)[0], shadow, 25).sum()
    )
    # After the goal the ball lies in the middle: no line leads there.
    clip = states("3-vs-1")
    light = [where(frame[BOARD:], (180, 210, 184), 40)[:, 100:200].sum() for frame in draw("3-vs-1", clip)]
    assert light[9] <= light[8] + 60
