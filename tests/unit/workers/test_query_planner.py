from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from accord.services.experiment_config import ExperimentConfig
from accord.workers.query_planner import choose_pairs
from mapt.errors import UnknownSelector
from mapt.preferences.selection import SegmentView, selector_names


def config(**changes) -> ExperimentConfig:
    return ExperimentConfig(task="HalfCheetah-6x1", **changes)


def uniform_pairs(ids, paired, k, *, first_round=False, seed=0):
    chosen = choose_pairs(config(), ids, paired, k, view=None, first_round=first_round, rng=np.random.default_rng(seed))
    assert {each.selector for each in chosen} <= {"uniform"}
    return [each.pair for each in chosen]


def view_of(n_segments, seed=0):
    rng = np.random.default_rng(seed)
    return SegmentView(rng.normal(size=(3, n_segments)), rng.normal(size=(n_segments, 4)), rng.normal(size=(7, 2, 4)))


@pytest.mark.parametrize("name", selector_names())
@given(st.integers(2, 60), st.integers(1, 30), st.booleans(), st.booleans(), st.integers(0, 2**32))
def test_pairs_are_new_different_and_as_many_as_wanted_or_left(name, n_segments, k, first_round, seen, seed):
    ids = [f"seg_{index}" for index in range(n_segments)]
    paired = {frozenset(pair) for pair in pairwise(ids)}
    chosen = choose_pairs(
        config(query_selection=name),
        ids,
        paired,
        k,
        # it may tell of some of the segments only
        view=view_of(max(2, n_segments // 2)) if seen and not first_round else None,
        first_round=first_round,
        rng=np.random.default_rng(seed),
    )
    either_way = {frozenset(each.pair) for each in chosen}
    assert len(either_way) == len(chosen)
    assert all(len(pair) == 2 for pair in either_way)
    assert not either_way & paired
    left = n_segments * (n_segments - 1) // 2 - len(paired)
    assert len(chosen) == min(k, left)


def test_later_rounds_look_at_what_the_policy_does_now():
    ids = [f"seg_{index}" for index in range(400)]
    recent = set(ids[:100])
    pairs = uniform_pairs(ids, set(), 200)
    assert all(set(pair) & recent for pair in pairs)
    assert 100 <= sum(set(pair) <= recent for pair in pairs) < 200


def test_first_round_draws_from_all():
    ids = [f"seg_{index}" for index in range(400)]
    pairs = uniform_pairs(ids, set(), 200, first_round=True)
    assert len({id for pair in pairs for id in pair} & set(ids[100:])) > 150


def test_either_order_is_as_likely():
    ids = [f"seg_{index:03}" for index in range(400)]
    pairs = uniform_pairs(ids, set(), 1000)
    assert 400 < sum(first < second for first, second in pairs) < 600


def test_same_seed_same_pairs():
    ids = [f"seg_{index}" for index in range(50)]
    first, second = (uniform_pairs(ids, set(), 9, seed=3) for _ in range(2))
    assert first == second


def test_an_informed_choice_is_among_the_segments_looked_into_and_each_pair_says_how_it_was_chosen():
    ids = [f"seg_{index}" for index in range(400)]
    chosen = choose_pairs(
        config(query_selection="disagreement", control_share=0.25),
        ids,
        set(),
        40,
        view=view_of(100),
        first_round=False,
        rng=np.random.default_rng(0),
    )
    assert Counter(each.selector for each in chosen) == {"uniform": 10, "disagreement": 30}
    assert {id for each in chosen for id in each.pair} <= set(ids[:100])
    # candidates are drawn as uniform pairs are: recent ones, and bridges to older behaviour
    recent = set(ids[:25])
    assert all(set(each.pair) & recent for each in chosen)


def test_a_selector_of_another_version_is_refused_by_name():
    unknown = ExperimentConfig.from_stored({"task": "HalfCheetah-6x1", "query_selection": "boredom"})
    with pytest.raises(UnknownSelector):
        choose_pairs(unknown, ["a", "b"], [], 1, view=None, first_round=True, rng=np.random.default_rng(0))
