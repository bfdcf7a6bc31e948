from collections import Counter
from itertools import combinations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapt.preferences.selection import UniformSelector


def selector(seed=0):
    return UniformSelector(np.random.default_rng(seed))


@given(st.integers(0, 12), st.integers(0, 80), st.integers(0, 2**16), st.data())
def test_no_pair_is_chosen_twice(n_segments, k, seed, data):
    ids = [f"s{i}" for i in range(n_segments)]
    every = list(combinations(ids, 2))
    paired = data.draw(st.sets(st.sampled_from(every))) if every else set()
    # Either order of an earlier pair counts as that pair.
    chosen = selector(seed).select(ids, {pair[::-1] for pair in paired}, k)
    unordered = [frozenset(pair) for pair in chosen]
    assert len(set(unordered)) == len(unordered) == min(k, len(every) - len(paired))
    assert not set(unordered) & {frozenset(pair) for pair in paired}
    assert set(unordered) <= {frozenset(pair) for pair in every}


def test_pairs_of_segments_no_longer_there_do_not_count():
    assert len(selector().select([1, 2], [(8, 9), (1, 9)], 5)) == 1


def test_every_pair_and_both_orders_are_drawn_alike():
    draws = Counter(selector(seed).select(range(4), [], 1)[0] for seed in range(2400))
    assert len(draws) == 12
    # Binomial with mean 200 and deviation 13.5: five deviations.
    assert all(abs(count - 200) < 68 for count in draws.values())


def test_the_same_generator_gives_the_same_pairs():
    ids, paired = list(range(30)), {(0, 1), (4, 2)}
    assert selector(3).select(ids, paired, 10) == selector(3).select(ids, paired, 10)
    assert selector(3).select(ids, paired, 10) != selector(4).select(ids, paired, 10)
