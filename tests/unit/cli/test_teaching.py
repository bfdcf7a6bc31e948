import pytest
from hypothesis import given
from hypothesis import strategies as st

from accord.cli.client import Api
from accord.cli.demo import describe
from accord.cli.demo_runs import RunPlan, RunState
from accord.cli.options import parse_numbers
from accord.cli.teach import Sight, judge, parse_teacher
from accord.domain.errors import Invalid
from mapt.preferences.teachers import make_teacher

REWARDS = st.lists(st.floats(-10, 10), min_size=3, max_size=3)


def query(rewards_0: list[float], rewards_1: list[float], left: int) -> dict:
    sides = [{"index": 0, "true_rewards": rewards_0}, {"index": 1, "true_rewards": rewards_1}]
    return {"left": sides[left], "right": sides[1 - left]}


def labels_of(*queries: dict, name: str = "oracle", **parameters: object) -> list[float | None]:
    teacher, api = make_teacher(name, **parameters), Api("http://localhost", "none")
    try:
        return judge(teacher, Sight(api, teacher), queries)
    finally:
        api.close()


@given(REWARDS, REWARDS, st.integers(0, 1))
def test_oracle_prefers_the_larger_return_whatever_side_it_is_on(rewards_0, rewards_1, left):
    here, there, turned = labels_of(
        query(rewards_0, rewards_1, left), query(rewards_0, rewards_1, 1 - left), query(rewards_1, rewards_0, left)
    )
    assert here == there
    assert here + turned == 1.0


def test_label_1_means_segment_0():
    assert labels_of(query([1, 1], [0, 0], left=1), query([1, 1], [2, 0], left=0)) == [1.0, 0.5]


def test_rewards_alone_are_enough_for_rules_about_them():
    # The API behind this is not there: nothing is asked of it.
    assert labels_of(query([0, 0, 3], [1, 1, 1], left=1), name="recency", window_steps=1) == [1.0]


def test_a_skip_is_none():
    assert labels_of(query([0.0], [0.0], left=0), query([5.0], [9.0], left=0), name="skip", skip=0.1) == [None, 0.0]


def test_parameters_are_json_or_words():
    choice = parse_teacher("phase+stochastic", ["want=equal", "column=0", "beta=2.5", "mistake=0.25"])
    told = choice.teacher(9).parameters()
    assert (told["want"], told["column"], told["beta"], told["mistake"], told["seed"]) == ("equal", 0, 2.5, 0.25, 9)
    assert parse_teacher("smoothness", ["columns=[0, 1]"]).teacher(0).parameters()["columns"] == [0, 1]
    assert parse_teacher("stochastic", ["beta=null"]).teacher(0).parameters()["beta"] is None


def test_a_seed_of_the_teachers_own_goes_before_the_runs():
    assert parse_teacher("mistake", ["seed=3"]).teacher(9).parameters()["seed"] == 3


@pytest.mark.parametrize(
    ("name", "parameters", "words"),
    [
        ("nobody", [], "no teacher is called 'nobody'"),
        ("oracle", ["mistake"], "KEY=VALUE"),
        ("oracle", ["=1"], "KEY=VALUE"),
        ("oracle", ["mistake=often"], "mistake of oracle must be a number"),
        ("oracle", ["mistake=2"], "0, 1"),
        ("oracle", ["colour=1"], "no parameter colour"),
        ("oracle", ["name=x"], "no parameter name"),
        ("oracle", ["seed=x"], "seed of oracle must be a whole number"),
        ("phase+myopic", [], "gamma"),
    ],
)
def test_a_teacher_that_cannot_be_is_refused_in_a_sentence(name, parameters, words):
    with pytest.raises(Invalid, match=words):
        parse_teacher(name, parameters)


def test_seeds_are_numbers_with_commas_each_once():
    assert parse_numbers("--seed", "0,1, 2", 0) == (0, 1, 2)
    for text in ("", "a", "1,1", "-1", "0;1"):
        with pytest.raises(Invalid, match="--seed"):
            parse_numbers("--seed", text, 0)


def test_words_beside_the_bar_say_how_far_it_is():
    plan = RunPlan("run", "HalfCheetah-6x1", "preferences", 0, 100, 50, 10, 5, False)
    words = describe(plan, RunState(steps=10, labels=7, version=2, true_return=-12.3, detail="training"))
    assert words == "labels 7/50 · version 2 · return -12 · training"
