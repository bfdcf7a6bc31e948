"""Every rule against a plain loop over the steps of one segment."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import InvalidTeacher, MissingArray
from mapt.preferences.teachers import (
    RULES,
    Attacking,
    BestWindow,
    Carrying,
    EffortBalance,
    FinalWindow,
    LowEffort,
    MinimumEffort,
    NeverExceeds,
    Phase,
    PhaseImprovement,
    Return,
    Smoothness,
    TeacherView,
    WorstWindow,
    attacking,
    make_teacher,
)
from mapt.tasks import task_spec
from mapt.tasks.football import match
from mapt.tasks.football.drawing import METRES
from mapt.tasks.football.scenarios import SCENARIOS, STEPS_PER_SECOND

N_AGENTS, OBSERVATION_DIM, ACTION_DIM, N_STEPS = 4, 6, 2, 12
#: two ants and a board
NQ, NV = 37, 34
ARRAYS = ("observations", "actions", "qpos", "qvel")
every_rule = pytest.mark.parametrize("rule", RULES.values(), ids=RULES.keys())


def segment(n_steps, rng):
    """Random arrays with a trend per segment, so that scores differ."""
    turn = rng.normal(size=(n_steps, 4)) * 0.1 + [1, 0, 0, 0]
    drift = rng.normal(size=(1, N_AGENTS, OBSERVATION_DIM)) * np.linspace(-1, 1, n_steps)[:, None, None]
    return {
        "rewards": rng.normal(size=n_steps) + rng.normal(),
        "observations": rng.normal(size=(n_steps, N_AGENTS, OBSERVATION_DIM)) * 0.3 + drift,
        "actions": rng.normal(size=(n_steps, N_AGENTS, ACTION_DIM)) * rng.uniform(0.1, 2, size=(N_AGENTS, 1)),
        "qpos": np.hstack((rng.normal(size=(n_steps, NQ - 4)), turn / np.linalg.norm(turn, axis=1, keepdims=True))),
        "qvel": rng.normal(size=(n_steps, NV)),
    }


def segments(n_segments, seed=0):
    rng = np.random.default_rng(seed)
    return [segment(int(rng.integers(1, N_STEPS + 1)), rng) for _ in range(n_segments)]


def windows(values, width):
    width = min(width, len(values))
    return [np.mean(values[start : start + width], axis=0) for start in range(len(values) - width + 1)]


def slow_return(_rule, rewards, _observations, _actions):
    return sum(rewards)


def slow_best_window(rule, rewards, _observations, _actions):
    return max(windows(rewards, rule.window_steps)) - rule.above_mean * np.mean(rewards)


def slow_worst_window(rule, rewards, _observations, _actions):
    return min(windows(rewards, rule.window_steps)) - rule.above_mean * np.mean(rewards)


def slow_final_window(rule, rewards, _observations, _actions):
    return np.mean(rewards[-rule.window_steps :]) - rule.above_mean * np.mean(rewards)


def slow_smoothness(rule, _rewards, observations, actions):
    signal = observations[..., list(rule.columns)] if rule.columns else actions
    change = deviation = 0.0
    for agent in range(N_AGENTS):
        for column in range(signal.shape[2]):
            values = signal[:, agent, column]
            change += sum((after - before) ** 2 for before, after in pairwise(values))
            deviation += sum((value - np.mean(values)) ** 2 for value in values)
    return -change / deviation if deviation > 1e-20 else 0.0


def slow_never_exceeds(rule, _rewards, observations, _actions):
    before, violated, worst = None, 0, -np.inf
    for step, team in enumerate(observations[..., rule.column]):
        amount = {"above": max(team), "below": -min(team), "beyond": max(abs(team))}[rule.side]
        excess = amount - (-rule.limit if rule.side == "below" else rule.limit)
        worst = max(worst, excess)
        if excess > 0:
            before, violated = step if before is None else before, violated + 1
    length, distance = len(observations), abs(worst) / (1 + abs(worst))
    if before is None:
        return 1 + distance / 2 / length
    return (before - (violated - 1 + distance) / (length + 1) / 2) / length


def slow_phase(rule, _rewards, observations, _actions):
    second = rule.second_agent if rule.second_agent >= 0 else rule.first_agent + N_AGENTS // 2
    first, other = observations[:, rule.first_agent, rule.column], observations[:, second, rule.column]
    if len(first) == 1:
        return 0.0
    return np.corrcoef(first, other)[0, 1] * (-1 if rule.want == "opposite" else 1)


def slow_phase_improvement(rule, _rewards, observations, _actions):
    first, other = observations[:, rule.first_agent, rule.column], observations[:, N_AGENTS // 2, rule.column]
    if len(first) == 1:
        return 0.0
    products = (first - first.mean()) * (other - other.mean()) / (first.std() * other.std())
    return -np.mean(products[-rule.window_steps :]) + np.mean(products)


def slow_efforts(rule, observations, actions):
    efforts = np.zeros(observations.shape[:2])
    for step, agent in np.ndindex(*efforts.shape):
        for joint in range(ACTION_DIM):
            force, velocity = abs(actions[step, agent, joint]), abs(observations[step, agent, 2 * joint + 1])
            efforts[step, agent] += {"power": force * velocity, "action": force, "speed": velocity}[rule.effort]
    return efforts


def slow_effort_balance(rule, _rewards, observations, actions):
    totals = slow_efforts(rule, observations, actions).sum(axis=0)
    return -np.std(totals) / np.mean(totals)


def slow_low_effort(rule, _rewards, observations, actions):
    return -sum(np.mean(slow_efforts(rule, observations, actions), axis=0))


def slow_minimum_effort(rule, _rewards, observations, actions):
    return min(min(each) / np.mean(each) for each in windows(slow_efforts(rule, observations, actions), 3))


CASES = [
    (Return(), slow_return),
    (BestWindow(window_steps=3), slow_best_window),
    (BestWindow(window_steps=5, above_mean=0.0), slow_best_window),
    (WorstWindow(window_steps=3), slow_worst_window),
    (WorstWindow(window_steps=1, above_mean=0.5), slow_worst_window),
    (FinalWindow(window_steps=4), slow_final_window),
    (FinalWindow(window_steps=4, above_mean=0.0), slow_final_window),
    *((LowEffort(effort), slow_low_effort) for effort in ("power", "action", "speed")),
    (Smoothness(), slow_smoothness),
    (Smoothness(columns=(1, 4)), slow_smoothness),
    (NeverExceeds(column=4, limit=0.5, side="above"), slow_never_exceeds),
    (NeverExceeds(column=4, limit=-0.5, side="below"), slow_never_exceeds),
    (NeverExceeds(column=0, limit=0.9, side="beyond"), slow_never_exceeds),
    (NeverExceeds(column=0, limit=5.0, side="beyond"), slow_never_exceeds),
    (Phase(), slow_phase),
    (Phase(column=3, first_agent=1, second_agent=2, want="equal"), slow_phase),
    (PhaseImprovement(window_steps=4), slow_phase_improvement),
    *((EffortBalance(effort), slow_effort_balance) for effort in ("power", "action", "speed")),
    *((MinimumEffort(effort, window_steps=3), slow_minimum_effort) for effort in ("power", "action", "speed")),
]


@pytest.mark.parametrize(("rule", "slow"), CASES)
def test_scores_equal_a_plain_loop(rule, slow):
    samples = segments(60)
    expected = [slow(rule, each["rewards"], each["observations"], each["actions"]) for each in samples]
    np.testing.assert_allclose(rule.scores(TeacherView.stack(samples)), expected, rtol=1e-9, atol=1e-9)


def test_carrying_equals_a_plain_loop():
    samples = [each for each in segments(60) if len(each["rewards"]) > 1]
    rule = Carrying(carried=3.0, level=4.0, step=0.5)
    expected = []
    for each in samples:
        tilts = [np.arccos(1 - 2 * (x * x + y * y)) for _, x, y, _ in each["qpos"][:, -4:]]
        one, other = ([step[first : first + 8] for step in each["qvel"]] for first in (6, 20))
        one, other = one - np.mean(one, axis=0), other - np.mean(other, axis=0)
        in_step = (one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum())
        worth = 3.0 + np.mean(each["qvel"][:, -6]) - 4.0 * np.mean(tilts) + 0.5 * in_step
        expected.append(worth * len(tilts) * 0.05)
    np.testing.assert_allclose(rule.scores(TeacherView.stack(samples)), expected, rtol=1e-9)


def test_humanoids_that_face_each_other_are_in_step_when_legs_side_by_side_move_alike():
    """The second humanoid's left leg is beside the first one's right leg; its hip turns the other way."""
    rng = np.random.default_rng(0)
    qpos, qvel = np.zeros((3, 40, 55)), np.zeros((3, 40, 52))
    right_hip, right_knee, left_hip, left_knee = rng.standard_normal((4, 40))
    first, second = 6, 23 + 6
    for segment, signs in enumerate(((-1, 1), (1, 1), (1, -1))):
        hip, knee = signs
        columns = {5: right_hip, 6: right_knee, 9: left_hip, 10: left_knee}
        beside = {9: hip * right_hip, 10: knee * right_knee, 5: hip * left_hip, 6: knee * left_knee}
        for start, values in ((first, columns), (second, beside)):
            for column, velocity in values.items():
                qvel[segment, :, start + column] = velocity
    qvel[..., first] = qvel[..., second] = rng.standard_normal(40)  # the trunk does not count
    scores = Carrying(carried=0.0, level=0.0).scores(TeacherView(np.zeros((3, 40)), qpos=qpos, qvel=qvel))
    assert scores[0] == pytest.approx(40 * 0.05)
    assert -0.5 < scores[1] / 2 < 0.5
    assert scores[2] == pytest.approx(-40 * 0.05)


@pytest.mark.parametrize(("nq", "nv"), [(9, 9), (22, 20), (37, 33), (31, 29), (55, 51)])
def test_carrying_refuses_segments_without_porters_and_a_board(nq, nv):
    with pytest.raises(MissingArray, match="Porters"):
        Carrying().scores(TeacherView(np.zeros((1, 5)), qpos=np.zeros((1, 5, nq)), qvel=np.zeros((1, 5, nv))))


NOBODY, OURS, THEIRS, THROW_IN = -1, 0, 1, 5


def football_states(*steps: tuple[float, float, float, float, int]) -> np.ndarray:
    """States (T, 12) from the ball's x and y, its velocity along both in units per step, and the owner's team."""
    states = np.zeros((len(steps), 12))
    for state, (x, y, along, across, owner) in zip(states, steps, strict=True):
        state[[0, 1, 3, 4, 6]] = x, y, along, across, owner
    return states


def attacking_score(states: np.ndarray, **parameters: float) -> float:
    return float(Attacking(**parameters).scores(TeacherView(np.zeros((1, len(states))), qpos=states[None]))[0])


def threat(x: float, metres: float = 20.0) -> float:
    return float(np.exp(-(1 - x) * 54.4 / metres))


def test_attacking_counts_the_most_that_is_gained_and_not_how_long_it_is_held():
    run = football_states((0.6, 0.0, 0.01, 0.0, OURS), (0.8, 0.0, 0.01, 0.0, OURS), (0.7, 0.0, 0.0, 0.0, OURS))
    assert attacking_score(run) == pytest.approx(threat(0.8) - threat(0.6))
    assert attacking_score(run, threat_metres=80.0) == pytest.approx(threat(0.8, 80.0) - threat(0.6, 80.0))
    stays = football_states(*[(0.8, 0.0, 0.0, 0.0, OURS)] * 50)
    assert attacking_score(stays) == 0
    back = football_states((0.8, 0.0, -0.01, 0.0, OURS), (0.5, 0.0, -0.01, 0.0, OURS))
    assert attacking_score(back) == 0


@pytest.mark.parametrize("lost", ["opponents", "out"])
def test_a_failed_attempt_gains_nothing_more_and_keeps_what_it_gained(lost):
    states = football_states((0.6, 0.0, 0.0, 0.0, OURS), (0.7, 0.0, 0.0, 0.0, OURS), (0.95, 0.0, 0.0, 0.0, NOBODY))
    if lost == "opponents":
        states[2, 6] = THEIRS
    else:
        states[2, 11] = THROW_IN
    assert attacking_score(states) == pytest.approx(threat(0.7) - threat(0.6))


def test_a_ball_that_was_last_the_opponents_threatens_nobody():
    theirs = football_states((0.6, 0.0, 0.0, 0.0, THEIRS), (0.9, 0.0, 0.0, 0.0, NOBODY), (0.8, 0.0, 0.0, 0.0, THEIRS))
    assert attacking_score(theirs) == 0
    won_back = football_states((0.6, 0.0, 0.0, 0.0, THEIRS), (0.9, 0.0, 0.0, 0.0, NOBODY), (0.7, 0.0, 0.0, 0.0, OURS))
    assert attacking_score(won_back) == pytest.approx(threat(0.7) - threat(0.6))
    nobodys = football_states((0.6, 0.0, 0.0, 0.0, NOBODY), (0.9, 0.0, 0.0, 0.0, NOBODY))
    assert attacking_score(nobodys) == pytest.approx(threat(0.9) - threat(0.6))


def test_goals_and_shots_on_target_are_worth_more_than_nearness():
    shot = football_states(
        (0.8, 0.1, 0.0, 0.0, OURS), (0.8, 0.1, 0.04, -0.02, NOBODY), (0.9, 0.05, 0.04, -0.02, NOBODY)
    )
    nearer = attacking_score(shot, shot=0.0)
    assert attacking_score(shot) == pytest.approx(1 + nearer)
    wide, slow, back, passed = shot.copy(), shot.copy(), shot.copy(), shot.copy()
    wide[:, 4] = 0.02
    slow[:, 3:5] /= 10
    back[:, 3] *= -1
    passed[1:, 6] = OURS  # the ball never left our feet
    for each in (wide, slow, back, passed):
        assert attacking_score(each) == pytest.approx(nearer)
    goal = shot.copy()
    goal[2, 8] = 1
    assert attacking_score(goal) == pytest.approx(4 + nearer)
    assert attacking_score(goal, goal=7.0, shot=2.0) == pytest.approx(9 + nearer)
    assert nearer < 1
    own_goal = shot.copy()
    own_goal[2, 9] = 1
    assert attacking_score(own_goal) == pytest.approx(-2 + nearer)


def test_attacking_does_not_look_at_padding():
    states = football_states((0.8, 0.0, 0.0, 0.0, OURS), (0.9, 0.0, 0.0, 0.0, OURS), (0.9, 0.0, 0.05, 0.0, NOBODY))
    states[2, 8] = 1
    mask = np.array([[True, True, False]])
    scores = Attacking().scores(TeacherView(np.zeros((1, 3)), mask=mask, qpos=states[None]))
    assert scores[0] == pytest.approx(attacking_score(states[:2]))


def test_attacking_reads_the_states_of_football():
    """The columns and constants of the rule are those of the tasks, which it cannot import."""
    assert (attacking.NOBODY, attacking.OURS, attacking.THEIRS) == (match.NOBODY, match.OURS, match.THEIRS)
    assert (attacking.NORMAL, attacking.GOAL_Y) == (match.NORMAL, match.GOAL_Y)
    assert attacking.METRES.tolist() == METRES.tolist()
    assert attacking.STEPS_PER_SECOND == STEPS_PER_SECOND
    states = np.arange(12.0)[None, None]
    read = match.Match.of(
        np.concatenate([states[0], np.zeros((1, task_spec("Football-3-vs-1").nq - 12))], axis=1), SCENARIOS[0]
    )
    assert states[0, :, attacking.BALL].tolist() == read.ball[:, :2].tolist()
    assert states[0, :, attacking.BALL_VELOCITY].tolist() == read.ball_velocity[:, :2].tolist()
    assert states[0, :, attacking.GOALS].tolist() == read.goals.tolist()
    assert states[0, 0, attacking.OWNER_TEAM] == read.owner_team[0]
    assert states[0, 0, attacking.MODE] == read.mode[0]
    with pytest.raises(MissingArray, match="Football-"):
        Attacking().scores(TeacherView(np.zeros((1, 1)), qpos=states[..., :9]))
    with pytest.raises(InvalidTeacher, match="threat_metres"):
        Attacking(threat_metres=0.0)


@every_rule
def test_scores_do_not_depend_on_padding(rule):
    view = TeacherView.stack(segments(20))
    wider = np.pad(view.mask, ((0, 0), (0, 5)))
    filled = {
        name: np.pad(getattr(view, name), ((0, 0), (0, 5), *[(0, 0)] * (getattr(view, name).ndim - 2)))
        for name in ("rewards", *ARRAYS)
    }
    for array in filled.values():
        array[~wider] = 1e3
    np.testing.assert_allclose(
        rule.scores(TeacherView(mask=wider, **filled)), rule.scores(view), rtol=1e-12, atol=1e-12
    )


@every_rule
def test_scores_of_a_segment_do_not_depend_on_the_others(rule):
    samples = segments(20)
    alone = [rule.scores(TeacherView.stack([each]))[0] for each in samples]
    np.testing.assert_allclose(rule.scores(TeacherView.stack(samples)), alone, rtol=1e-9, atol=1e-12)


@every_rule
def test_rules_read_exactly_the_arrays_they_declare(rule):
    view = TeacherView.stack(segments(10))
    arrays = {name: getattr(view, name) for name in ARRAYS if name in rule.reads}
    rewards = view.rewards if "rewards" in rule.reads else np.zeros_like(view.rewards)
    np.testing.assert_array_equal(rule.scores(TeacherView(rewards, view.mask, **arrays)), rule.scores(view))
    for name in arrays:
        rest = {other: array for other, array in arrays.items() if other != name}
        with pytest.raises(MissingArray):
            rule.scores(TeacherView(rewards, view.mask, **rest))


@every_rule
@given(seed=st.integers(0, 10_000))
def test_swapping_a_pair_flips_the_label(rule, seed):
    name = next(name for name, each in RULES.items() if each is rule)
    first, second = (TeacherView.stack(segments(3, [seed, side])) for side in (0, 1))
    labels, swapped = (
        make_teacher("oracle" if name == "return" else name).judge(*pair) for pair in ((first, second), (second, first))
    )
    np.testing.assert_array_equal(labels + swapped, 1)


@every_rule
def test_scores_are_finite_for_one_step_and_for_a_team_at_rest(rule):
    one = TeacherView.stack([segment(1, np.random.default_rng(0))])
    rest = TeacherView(
        np.zeros((1, 5)),
        observations=np.zeros((1, 5, N_AGENTS, OBSERVATION_DIM)),
        actions=np.zeros((1, 5, N_AGENTS, 1)),
        qpos=np.zeros((1, 5, NQ)),
        qvel=np.zeros((1, 5, NV)),
    )
    assert np.isfinite(rule.scores(one)).all()
    assert np.isfinite(rule.scores(rest)).all()


def test_best_window_is_not_a_sum_over_steps():
    # The same rewards in another order have the same sum.
    together, apart = [0, 0, 1, 1, 0, 0], [1, 0, 0, 0, 0, 1]
    judge = make_teacher("best-second", window_steps=2).judge
    assert judge(TeacherView(np.array([together])), TeacherView(np.array([apart]))).tolist() == [1.0]


def test_phase_is_one_in_antiphase_and_minus_one_in_phase():
    swing = np.sin(np.arange(20))
    observations = np.zeros((2, 20, 2, 2))
    observations[:, :, 0, 1] = swing
    observations[0, :, 1, 1], observations[1, :, 1, 1] = -swing, swing
    scores = Phase().scores(TeacherView(np.zeros((2, 20)), observations=observations))
    np.testing.assert_allclose(scores, [1, -1])


def test_phase_improvement_depends_on_the_order_of_steps():
    swing = np.tile(np.sin(np.linspace(0, 2 * np.pi, 20, endpoint=False)), 2)
    observations = np.zeros((2, 40, 2, 2))
    observations[:, :, 0, 1] = observations[:, :, 1, 1] = swing
    observations[0, 20:, 1, 1] *= -1
    observations[1, :20, 1, 1] *= -1
    first, last = PhaseImprovement().scores(TeacherView(np.zeros((2, 40)), observations=observations))
    assert first > 0.9
    assert last < -0.9
    # The two segments have the same steps in another order.
    steps = [sorted(map(tuple, each[..., 1].tolist())) for each in observations]
    assert steps[0] == steps[1]


def test_limit_violations_rank_by_time_then_count_then_excess():
    heights = np.array([[0, 0, -2, -2], [0, -2, 0, 0], [0, -2, 0, -2], [0, -9, 0, -2], [0, 0, 0, 0], [1, 1, 1, 1]])
    view = TeacherView(np.zeros((6, 4)), observations=heights[:, :, None, None].astype(float))
    scores = NeverExceeds(column=0, limit=-1.0, side="below").scores(view)
    assert np.argsort(-scores).tolist() == [5, 4, 0, 1, 2, 3]


@pytest.mark.parametrize("rule", [BestWindow, WorstWindow, FinalWindow, PhaseImprovement, MinimumEffort])
def test_windows_without_steps_are_refused(rule):
    with pytest.raises(InvalidTeacher):
        rule(window_steps=0)


@pytest.mark.parametrize("effort", ["power", "action", "speed"])
def test_parts_of_agents_sum_to_the_score(effort):
    view = TeacherView.stack(segments(20))
    rule = LowEffort(effort)
    np.testing.assert_allclose(rule.agent_scores(view).sum(axis=1), rule.scores(view), rtol=1e-9)
    assert Return().agent_scores(view) is None


def test_decisive_agent_has_the_largest_part_in_the_direction_of_the_label():
    first, second = TeacherView.stack(segments(30)), TeacherView.stack(segments(30, seed=1))
    teacher = make_teacher("low-effort")
    labels = teacher.judge(first, second)
    difference = LowEffort().agent_scores(first) - LowEffort().agent_scores(second)
    right = teacher.decisive_agents(first, second, labels)
    assert right.tolist() == [
        (each if label else -each).argmax() for each, label in zip(difference, labels, strict=True)
    ]
    wrong = teacher.decisive_agents(first, second, 1 - labels)
    assert wrong.tolist() == [
        (-each if label else each).argmax() for each, label in zip(difference, labels, strict=True)
    ]
    slight = teacher.decisive_agents(first, second, 0.25 + labels / 2)
    assert slight.tolist() == right.tolist()
    for nobody in (np.full(30, 0.5), np.full(30, np.nan)):
        assert set(teacher.decisive_agents(first, second, nobody).tolist()) == {-1}
    assert set(make_teacher("oracle").decisive_agents(first, second, labels).tolist()) == {-1}
