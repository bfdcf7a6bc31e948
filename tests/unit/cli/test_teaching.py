import pytest
from hypothesis import given
from hypothesis import strategies as st

from accord.cli.demo import describe, parse_seeds
from accord.cli.runs import RunPlan, RunState
from accord.cli.teaching import TeacherName, judge, make_teacher
from accord.domain.errors import Invalid

REWARDS = st.lists(st.floats(-10, 10), min_size=3, max_size=3)


def query(rewards_0: list[float], rewards_1: list[float], left: int) -> dict:
    sides = [{"index": 0, "true_rewards": rewards_0}, {"index": 1, "true_rewards": rewards_1}]
    return {"left": sides[left], "right": sides[1 - left]}


@given(REWARDS, REWARDS, st.integers(0, 1))
def test_oracle_prefers_the_larger_return_whatever_side_it_is_on(rewards_0, rewards_1, left):
    label = judge(make_teacher(TeacherName.ORACLE), query(rewards_0, rewards_1, left))
    assert label == judge(make_teacher(TeacherName.ORACLE), query(rewards_0, rewards_1, 1 - left))
    assert label + judge(make_teacher(TeacherName.ORACLE), query(rewards_1, rewards_0, left)) == 1.0


def test_label_1_means_segment_0():
    assert judge(make_teacher(TeacherName.ORACLE), query([1, 1], [0, 0], left=1)) == 1.0
    assert judge(make_teacher(TeacherName.ORACLE), query([1, 1], [2, 0], left=0)) == 0.5


def test_seeds_are_numbers_with_commas_each_once():
    assert parse_seeds("0,1, 2") == [0, 1, 2]
    for text in ("", "a", "1,1", "-1", "0;1"):
        with pytest.raises(Invalid, match="--seed"):
            parse_seeds(text)


def test_words_beside_the_bar_say_how_far_it_is():
    plan = RunPlan("run", "HalfCheetah-6x1", "preferences", 0, 100, 50, 10, 5, False)
    words = describe(plan, RunState(steps=10, labels=7, version=2, true_return=-12.3, detail="training"))
    assert words == "labels 7/50 · version 2 · return -12 · training"
