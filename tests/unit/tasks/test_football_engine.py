"""Football on its engine. `make football` installs it and runs these tests."""

import warnings
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from mapt.errors import InvalidAction, InvalidConfig, InvalidSnapshot
from mapt.policies import Learner, PolicyConfig
from mapt.tasks import MaskingTask, make_task
from mapt.tasks.football.engine import ACTIONS, ENGINE, INSTALL, EngineMatch, is_installed
from mapt.tasks.football.match import NORMAL, THEIRS, Match
from mapt.tasks.football.scenarios import SCENARIOS, Scenario
from mapt.tasks.football.task import Football

pytestmark = pytest.mark.skipif(not is_installed(), reason=f"{ENGINE} is not installed: {INSTALL}")

Make = Callable[..., Football]
NAMES = [scenario.name for scenario in SCENARIOS]
FIELDS = ("observations", "state", "reward", "terminated", "truncated", "final_observations", "final_state")


@pytest.fixture
def make() -> Iterator[Make]:
    made = []

    def make_one(name: str, n_envs: int = 1) -> Football:
        task = make_task(name, n_envs)
        assert isinstance(task, Football)
        made.append(task)
        return task

    yield make_one
    for task in made:
        task.close()


def random_actions(task: Football, rng: np.random.Generator) -> NDArray:
    available = task.available_actions()
    return np.eye(task.spec.action_dim)[(available * rng.random(available.shape)).argmax(axis=2)]


@pytest.mark.parametrize("scenario", SCENARIOS, ids=NAMES)
def test_matches_equal_those_of_google_research_football(scenario: Scenario) -> None:
    with warnings.catch_warnings(action="ignore"):
        from gfootball.env.config import Config
        from gfootball.env.football_env_core import FootballEnvCore

    seed, rng = 1234567, np.random.default_rng(1)
    config = Config({"level": scenario.engine_name, "players": [f"agent:left_players={scenario.n_agents}"]})
    config["game_engine_random_seed"], config["reverse_team_processing"] = seed, bool(seed % 2)
    theirs, ours = FootballEnvCore(config), EngineMatch(scenario)
    theirs.reset()
    state = ours.start(seed)
    for _ in range(75):
        raw, match = theirs.observation(), Match.of(state[None], scenario)
        for found, name in (
            (match.ball, "ball"),
            (match.ball_velocity, "ball_direction"),
            (match.team.position, "left_team"),
            (match.opponents.position, "right_team"),
            (match.controlled, "left_agent_controlled_player"),
            (match.sticky, "left_agent_sticky_actions"),
        ):
            np.testing.assert_array_equal(found[0], raw[name], err_msg=name)
        assert match.elapsed_steps[0] == 401 - raw["steps_left"]
        actions = rng.integers(len(ACTIONS), size=scenario.n_agents).tolist()
        *_, over, _ = theirs.step(actions)
        state, ended, first = ours.step(tuple(actions), seed)
        assert ended == over
        if first is not None:
            theirs.reset()
            state = first


@pytest.mark.parametrize(("name", "n_steps"), [("Football-3-vs-1", 100), ("Football-counterattack-hard", 20)])
def test_equal_seeds_give_equal_episodes_and_a_snapshot_continues_bit_for_bit(
    make: Make, name: str, n_steps: int
) -> None:
    first, second = make(name, 2), make(name, 2)
    assert isinstance(first, MaskingTask)
    for one, other in zip(first.reset(5), second.reset(5), strict=True):
        np.testing.assert_array_equal(one, other)
    rng, snapshot, ended = np.random.default_rng(1), {}, 0
    played = []
    for step in range(n_steps):
        if step == n_steps // 4:
            snapshot = first.snapshot()
        actions = random_actions(first, rng)
        result, other = first.step(actions), second.step(actions)
        ended += int((result.terminated | result.truncated).sum())
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(result, field), getattr(other, field))
        if step >= n_steps // 4:
            played.append((actions, result))
    assert ended or n_steps < 100  # so that the seeds of the next episodes matter
    second.reset(6)
    second.restore(snapshot)
    for actions, result in played:
        again = second.step(actions)
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(result, field), getattr(again, field))
    np.testing.assert_array_equal(first.simulator_state()[0], second.simulator_state()[0])
    np.testing.assert_array_equal(first.available_actions(), second.available_actions())
    with pytest.raises(InvalidSnapshot):
        second.restore({**snapshot, "saved_matches": snapshot["saved_matches"][:-1]})
    with pytest.raises(InvalidSnapshot):
        second.restore({name: array for name, array in snapshot.items() if name != "seeds"})


def test_actions_move_players_and_unavailable_ones_are_refused(make: Make) -> None:
    task = make("Football-3-vs-1")
    task.reset(0)
    before = Match.of(task.simulator_state()[0], SCENARIOS[0])
    up = np.eye(19)[[[ACTIONS.index("top")] * 3]]
    for _ in range(8):
        step = task.step(up)
    after = Match.of(task.simulator_state()[0], SCENARIOS[0])
    assert after.team.position[0, 3, 1] < before.team.position[0, 3, 1] - 0.02
    assert after.sticky[0, :, ACTIONS.index("top") - 1].all()
    assert step.observations.shape == (1, 3, task.spec.observation_dim)
    assert (step.observations[0, :, :19] == task.available_actions()[0]).all()
    for wrong in (
        np.eye(19)[[[ACTIONS.index("release_sprint")] * 3]],
        np.zeros((1, 3, 4)),
        np.full((1, 3, 19), np.nan),
    ):
        with pytest.raises(InvalidAction):
            task.step(wrong)
    with pytest.raises(InvalidConfig):
        make_task("Football-3-vs-1", 0)


def test_the_last_state_of_a_match_is_shown_before_the_next_one(make: Make) -> None:
    task = make("Football-3-vs-1", 4)
    task.reset(3)
    rng, shown = np.random.default_rng(0), 0
    while shown < 6:
        match = Match.of(task.simulator_state()[0], SCENARIOS[0])
        ended = ~task.available_actions()[..., 1:].any(axis=(1, 2))
        lost = (match.owner_team == THEIRS) | (match.mode != NORMAL) | match.goals.any(axis=1)
        assert lost[ended].all()
        assert not ((match.mode != NORMAL) | match.goals.any(axis=1))[~ended].any()
        actions, snapshot = random_actions(task, rng), task.snapshot()
        step = task.step(actions)
        if ended.any():
            task.restore(snapshot)
            again = task.step(actions)
            for field in FIELDS:
                np.testing.assert_array_equal(getattr(step, field), getattr(again, field))
        np.testing.assert_array_equal(step.terminated, ended)
        assert not step.reward[ended].any()
        after = Match.of(task.simulator_state()[0], SCENARIOS[0])
        assert (after.elapsed_steps[ended] < 2).all()  # the next match
        np.testing.assert_array_equal(step.success, after.goals[:, 0] == 1)
        shown += int(ended.sum())


def test_a_policy_trains_on_it(make: Make) -> None:
    config = PolicyConfig(n_envs=2, rollout_steps=8, minibatches=1, epochs=1, hidden=(4,), device="cpu")
    task = make("Football-pass-and-shoot", 2)
    learner = Learner(task, config)
    rollout = learner.collect()
    assert rollout.available_actions is not None
    assert (rollout.actions <= rollout.available_actions).all()
    assert rollout.qpos.shape[2] == task.spec.nq
    learner.update(rollout, rollout.rewards)
