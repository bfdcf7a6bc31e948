from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from accord.domain.schedule import LabelSchedule, LabelScheduleName

NAMES = get_args(LabelScheduleName)
TOTAL = 1000


def schedule(name: LabelScheduleName, budget: int = 1100, initial: int = 100) -> LabelSchedule:
    return LabelSchedule(budget, initial, TOTAL, name=name)


@pytest.mark.parametrize("name", NAMES)
@given(st.integers(2, 500), st.data(), st.integers(0, 2 * TOTAL), st.integers(0, 2 * TOTAL))
def test_due_goes_from_the_first_labels_to_the_budget_and_never_back(name, budget, data, one, other):
    asked = schedule(name, budget, data.draw(st.integers(2, budget)))
    assert asked.due(0) == asked.initial
    assert asked.due(min(one, other)) <= asked.due(max(one, other))
    assert asked.due(750) == asked.due(2 * TOTAL) == budget


def test_a_constant_rate_asks_for_as_many_in_every_part():
    due = [schedule("constant").due(steps) for steps in (0, 150, 300, 450, 600, 750)]
    assert due == [100, 300, 500, 700, 900, 1100]


def test_a_decaying_rate_has_fallen_to_half_after_a_tenth_of_the_run():
    asked = LabelSchedule(10**7, 2, 10**6, name="decaying")

    def rate(steps: int) -> float:
        return (asked.due(steps + 1000) - asked.due(steps)) / 1000

    assert rate(100_000) / rate(0) == pytest.approx(1 / 2, rel=0.01)
    assert rate(400_000) / rate(0) == pytest.approx(1 / 5, rel=0.01)


def test_the_default_is_what_it_was_before_there_were_names():
    due = [LabelSchedule(500, 100, TOTAL).due(steps) for steps in (0, 100, 375, 700)]
    assert due == [100 + int(400 * (steps / 750) ** 0.7) for steps in (0, 100, 375, 700)]


def test_early_steps_ask_for_the_most_where_the_rate_decays():
    assert schedule("constant").due(200) < schedule("power").due(200) < schedule("decaying").due(200)
