"""What a skirmish looks like."""

import numpy as np
import pytest
from numpy.typing import NDArray

from mapt.tasks import find_drawing, frame_rate_hz, make_task, task_spec
from mapt.tasks.canvas import Canvas
from mapt.tasks.skirmish.maps import MAPS

#: pure colours, which nothing else has
COLOURS = [(255, 0, 255), (0, 255, 255), (255, 255, 0)]
SIZE = (240, 320)
HEALTH, SHIELD, ENEMY, AGENT_SHOT = (92, 214, 92), (110, 180, 255), (150, 32, 40), (255, 250, 205)


def state(name: str = "3m", **columns: object) -> NDArray[np.float64]:
    """A state (1, nq): agents in a column at x = 12, enemies in one at x = 18, unhurt."""
    units = next(battle_map.units for battle_map in MAPS if battle_map.name == name)
    n = task_spec(name).n_agents
    numbers = np.zeros((len(units), 5))
    numbers[:, 0] = [12.0] * n + [18.0] * (len(units) - n)
    numbers[:, 1] = [10.0 + 2 * row for row in (*range(n), *range(len(units) - n))]
    numbers[:, 2], numbers[:, 3] = [unit.health for unit in units], [unit.shield for unit in units]
    numbers[:, 4] = -1
    for column, name_of_column in enumerate(("x", "y", "health", "shield", "hit")):
        if name_of_column in columns:
            numbers[:, column] = columns[name_of_column]
    return numbers.reshape(1, -1)


def draw(states: NDArray[np.float64], name: str = "3m", size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    drawing = find_drawing(name)
    assert drawing is not None
    colours = [COLOURS[agent % 3] for agent in range(task_spec(name).n_agents)]
    return np.stack(list(drawing.frames(states, *size, colours)))


def where(frame: NDArray[np.uint8], colour: tuple[int, int, int], tolerance: int = 12) -> NDArray[np.bool_]:
    return np.abs(frame.astype(int) - colour).max(axis=-1) <= tolerance


@pytest.mark.parametrize("name", [battle_map.name for battle_map in MAPS])
def test_a_drawing_is_a_pure_function_of_the_states(name: str) -> None:
    task = make_task(name, 1)
    task.reset(0)
    states = task.simulator_state()[0]
    kept = states.copy()
    frames = draw(states, name)
    assert frames.shape == (1, *SIZE, 3)
    np.testing.assert_array_equal(frames, draw(states, name))
    np.testing.assert_array_equal(states, kept)
    assert frame_rate_hz(name) == 8.0


def test_frames_of_a_clip_have_one_scale() -> None:
    together = draw(np.concatenate([state(), state(x=[2, 12, 12, 30, 18, 18])]))
    alone = draw(state())
    assert where(together[0], COLOURS[1]).sum() < where(alone[0], COLOURS[1]).sum()


def test_agents_have_their_colours_and_enemies_theirs() -> None:
    frame = draw(state())[0]
    map_only = frame[:, 40:-40]
    for colour in COLOURS:
        assert where(map_only, colour).sum() > 20
    columns = np.flatnonzero(where(map_only, ENEMY).any(axis=0))
    assert columns.min() > np.flatnonzero(where(map_only, COLOURS[0]).any(axis=0)).max()
    # North is up: the second agent is above the first.
    rows = [np.flatnonzero(where(map_only, colour).any(axis=1)).mean() for colour in COLOURS]
    assert rows[0] > rows[1] > rows[2]


def test_agents_are_not_hidden_by_enemies() -> None:
    apart = draw(state(x=[8, 12, 16, 20, 20, 20]))[0][:, 40:-40]
    close = draw(state(x=[8, 12, 16, 16.4, 20, 20], y=[16, 16, 16, 16, 12, 20]))[0][:, 40:-40]
    shown = [where(frame, COLOURS[2]).sum() for frame in (apart, close)]
    # The enemy's bar covers a part of the agent, but the enemy does not.
    assert shown[1] > 0.7 * shown[0]


def test_units_below_a_medivac_stay_visible() -> None:
    """MMM2's last agent and last enemy are medivacs; here a marine of the agents is below each."""
    n, n_units = task_spec("MMM2").n_agents, state("MMM2").size // 5
    apart = state("MMM2").reshape(n_units, 5)
    below = apart.copy()
    # A little south, where the bars of the medivacs are not.
    below[0, :2], below[1, :2] = apart[n - 1, :2] - [0, 0.4], apart[-1, :2] - [0, 0.4]
    colours = [COLOURS[0], COLOURS[1], *[(200, 200, 200)] * (n - 2)]
    drawing = find_drawing("MMM2")
    assert drawing is not None
    frames = [next(iter(drawing.frames(each.reshape(1, -1), 360, 480, colours))) for each in (apart, below)]
    for colour in COLOURS[:2]:
        shown = [where(frame[:, 60:-60], colour).sum() for frame in frames]
        assert shown[1] > 0.7 * shown[0]


def test_agents_with_a_repeated_colour_have_a_ring() -> None:
    """Agent 9 is shown in a colour of its own, and in that of agent 1."""
    drawing = find_drawing("MMM2")
    assert drawing is not None
    others = [(200, 200, 10 * agent) for agent in range(2, 10)]

    def coloured(first: tuple[int, int, int]) -> int:
        colours = [first, *others[:7], COLOURS[0], others[7]]
        frame = next(iter(drawing.frames(state("MMM2"), 360, 480, colours)))
        return int(where(frame, COLOURS[0]).sum())

    alone = coloured((200, 200, 0))
    first = int(
        where(next(iter(drawing.frames(state("MMM2"), 360, 480, [COLOURS[0], *others, (9, 9, 9)]))), COLOURS[0]).sum()
    )
    assert 0.5 * alone < coloured(COLOURS[0]) - first < 0.8 * alone


def test_bars_show_health_and_shields() -> None:
    full, half = draw(state())[0], draw(state(health=[45, 45, 45, 22.5, 22.5, 22.5]))[0]
    # In the list of enemies, right of the map.
    bars = [where(frame[:, -40:], HEALTH).sum() for frame in (full, half)]
    assert bars[1] == pytest.approx(0.5 * bars[0], rel=0.1)
    assert not where(full, SHIELD).any()
    assert where(draw(state("3s5z"), "3s5z")[0], SHIELD).sum() > 100


def test_the_dead_have_no_colour_and_do_not_see() -> None:
    dead = draw(state(health=[0, 45, 45, 45, 45, 45]))[0]
    assert not where(dead, COLOURS[0]).any()
    assert where(dead, COLOURS[1]).any()
    nobody, all_ = draw(state(health=[0, 0, 0, 45, 45, 45]))[0], draw(state())[0]
    assert not where(nobody, (66, 76, 89), 3).any()
    assert where(all_, (66, 76, 89), 3).mean() > 0.2


def test_a_line_joins_a_unit_with_the_one_that_it_hit() -> None:
    quiet, shots = draw(state())[0], draw(state(hit=[3, -1, -1, -1, -1, -1]))[0]
    changed = np.abs(shots.astype(int) - quiet).max(axis=-1) > 30
    rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
    assert np.ptp(columns) > 4 * np.ptp(rows)
    assert where(shots, AGENT_SHOT, 40).sum() > 10


def test_edges_are_anti_aliased_and_shapes_may_leave_the_image() -> None:
    canvas = Canvas(20, 20, (0, 0, 0))
    canvas.disc(10.0, 10.0, 5.0, (200, 200, 200))
    disc = canvas.image()[..., 0]
    assert set(np.unique(disc)) > {0, 200}
    assert disc.sum() / 200 == pytest.approx(np.pi * 25, rel=0.02)
    canvas = Canvas(20, 20, (0, 0, 0))
    canvas.rectangle(2.5, 3.0, 4.0, 2.0, (200, 200, 200))
    assert canvas.image()[3, :8, 0].tolist() == [0, 0, 100, 200, 200, 200, 100, 0]
    assert canvas.image()[..., 0].sum() == 200 * 8
    for outside in (-50.0, 70.0):
        canvas.disc(outside, 5, 4, (255, 0, 0))
        canvas.line((outside, 5), (outside, 9), 2, (255, 0, 0))
        canvas.diamond(outside, 5, 4, (255, 0, 0))
    assert not canvas.image()[..., 0].max() > 200
    canvas.line((-5, 10), (25, 10), 2, (255, 255, 255))
    assert (canvas.image()[9:11] == 255).all()
    canvas.number(10, 10, 10, 10, (0, 0, 255))
    assert where(canvas.image(), (0, 0, 255)).sum() > 30
