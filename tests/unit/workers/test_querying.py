from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from accord.workers.querying import choose_pairs


@given(st.integers(2, 60), st.integers(1, 30), st.booleans(), st.integers(0, 2**32))
def test_pairs_are_new_different_and_as_many_as_wanted_or_left(n_segments, k, first_round, seed):
    ids = [f"seg_{index}" for index in range(n_segments)]
    paired = {frozenset(pair) for pair in pairwise(ids)}
    pairs = choose_pairs(ids, paired, k, first_round=first_round, rng=np.random.default_rng(seed))
    either_way = {frozenset(pair) for pair in pairs}
    assert len(either_way) == len(pairs)
    assert all(len(pair) == 2 for pair in either_way)
    assert not either_way & paired
    left = n_segments * (n_segments - 1) // 2 - len(paired)
    assert len(pairs) == min(k, left)


def test_later_rounds_look_at_what_the_policy_does_now():
    ids = [f"seg_{index}" for index in range(400)]
    recent = set(ids[:100])
    pairs = choose_pairs(ids, set(), 200, first_round=False, rng=np.random.default_rng(0))
    assert all(set(pair) & recent for pair in pairs)
    assert 100 <= sum(set(pair) <= recent for pair in pairs) < 200


def test_first_round_draws_from_all():
    ids = [f"seg_{index}" for index in range(400)]
    pairs = choose_pairs(ids, set(), 200, first_round=True, rng=np.random.default_rng(0))
    assert len({id for pair in pairs for id in pair} & set(ids[100:])) > 150


def test_either_order_is_as_likely():
    ids = [f"seg_{index:03}" for index in range(400)]
    pairs = choose_pairs(ids, set(), 1000, first_round=False, rng=np.random.default_rng(0))
    assert 400 < sum(first < second for first, second in pairs) < 600


def test_same_seed_same_pairs():
    ids = [f"seg_{index}" for index in range(50)]
    first, second = (choose_pairs(ids, set(), 9, first_round=False, rng=np.random.default_rng(3)) for _ in range(2))
    assert first == second
