from collections import Counter
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import UnknownSelector
from mapt.preferences.selection import (
    SegmentView,
    SelectorName,
    UniformSelector,
    make_selector,
    needs_ensemble,
    needs_features,
    selector_names,
)

every_selector = pytest.mark.parametrize("name", selector_names())


def selector(seed=0):
    return UniformSelector(np.random.default_rng(seed))


def random_view(n_segments, seed=0, members=3):
    rng = np.random.default_rng(seed)
    return SegmentView(scores=rng.normal(size=(members, n_segments)), features=rng.normal(size=(n_segments, 4)))


@every_selector
@given(st.integers(0, 12), st.integers(0, 80), st.integers(0, 2**16), st.data())
def test_no_pair_is_chosen_twice(name, n_segments, k, seed, data):
    ids = [f"s{i}" for i in range(n_segments)]
    every = list(combinations(ids, 2))
    paired = data.draw(st.sets(st.sampled_from(every))) if every else set()
    # Either order of an earlier pair counts as that pair.
    choose = make_selector(name, np.random.default_rng(seed)).select
    chosen = choose(ids, {pair[::-1] for pair in paired}, k, random_view(n_segments))
    unordered = [frozenset(pair) for pair in chosen]
    assert len(set(unordered)) == len(unordered) == min(k, len(every) - len(paired))
    assert not set(unordered) & {frozenset(pair) for pair in paired}
    assert set(unordered) <= {frozenset(pair) for pair in every}


@given(st.integers(80, 200), st.integers(1, 60), st.integers(0, 2**16))
def test_no_pair_is_chosen_twice_out_of_many(n_segments, k, seed):
    paired = [(i, i + 1) for i in range(n_segments - 1)]
    chosen = {frozenset(pair) for pair in selector(seed).select(range(n_segments), paired, k)}
    assert len(chosen) == k
    assert all(len(pair) == 2 for pair in chosen)
    assert not chosen & {frozenset(pair) for pair in paired}


def test_pairs_of_segments_no_longer_there_do_not_count():
    assert len(selector().select([1, 2], [(8, 9), (1, 9)], 5)) == 1


# Three of six pairs wanted takes the way of listing them all, one of six that of drawing until one is free.
@pytest.mark.parametrize(("n_segments", "k"), [(4, 1), (4, 3)])
def test_every_pair_and_both_orders_are_drawn_alike(n_segments, k):
    draws = Counter(pair for seed in range(2400 // k) for pair in selector(seed).select(range(n_segments), [(0, 3)], k))
    assert len(draws) == 10
    # Binomial with mean 240 and deviation 14.7: five deviations.
    assert all(abs(count - 240) < 74 for count in draws.values())


@every_selector
def test_either_order_is_as_likely(name):
    ids = range(60)
    chosen = make_selector(name, np.random.default_rng(0)).select(ids, [], 150, random_view(60))
    # Binomial with mean 75 and deviation 6.1: five deviations.
    assert abs(sum(first < second for first, second in chosen) - 75) < 31


@every_selector
def test_the_same_generator_gives_the_same_pairs(name):
    ids, paired = list(range(30)), {(0, 1), (4, 2)}

    def chosen(seed):
        return make_selector(name, np.random.default_rng(seed)).select(ids, paired, 10, random_view(30))

    assert chosen(3) == chosen(3)
    assert chosen(3) != chosen(4)


def test_a_selector_is_recorded_under_the_name_that_made_it():
    assert [make_selector(name, np.random.default_rng(0)).name for name in selector_names()] == list(selector_names())


def test_an_unknown_name_is_refused_with_the_known_ones():
    name: SelectorName = "random"  # type: ignore[assignment]
    with pytest.raises(UnknownSelector, match=r"'random'.*uniform, disagreement"):
        make_selector(name, np.random.default_rng(0))


def test_which_selectors_need_an_ensemble_and_which_features():
    assert {name for name in selector_names() if needs_ensemble(name)} == {
        "disagreement",
        "entropy",
        "disagreement_k_center",
        "entropy_k_center",
    }
    assert {name for name in selector_names() if needs_features(name)} == {
        "k_center",
        "disagreement_k_center",
        "entropy_k_center",
    }
