from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import InvalidConfig
from mapt.preferences.selection import ControlledSelector, SegmentView, UniformSelector, control_count, make_selector

VIEW = SegmentView(scores=np.random.default_rng(0).normal(size=(3, 30)))


def controlled(share, seed=0):
    rng = np.random.default_rng(seed)
    return ControlledSelector(make_selector("disagreement", rng), UniformSelector(rng), share, rng)


@given(st.integers(0, 50), st.floats(0, 1), st.integers(0, 2**16))
def test_a_batch_is_never_a_whole_query_off_its_share(k, share, seed):
    n_control = control_count(k, share, np.random.default_rng(seed))
    assert 0 <= n_control <= k
    assert abs(n_control - k * share) < 1 + 1e-9


@pytest.mark.parametrize(("k", "share"), [(1, 0.2), (3, 0.2), (7, 0.35), (10, 0.1)])
def test_the_control_share_is_exact_on_average(k, share):
    rng = np.random.default_rng(1)
    rounds = 20_000
    total = sum(control_count(k, share, rng) for _ in range(rounds))
    # a rounded number has deviation 1/2 at most: five of those of the mean
    assert abs(total / rounds - k * share) < 5 * 0.5 / np.sqrt(rounds)


@given(
    st.integers(0, 40),
    st.floats(0, 1),
    st.integers(0, 2**16),
    st.sets(st.tuples(st.integers(0, 29), st.integers(0, 29))),
)
def test_every_pair_is_new_and_says_how_it_was_chosen(k, share, seed, paired):
    paired = {pair for pair in paired if pair[0] != pair[1]}
    chosen = controlled(share, seed).choose(range(30), paired, k, VIEW)
    pairs = [frozenset(each.pair) for each in chosen]
    assert len(set(pairs)) == len(pairs) == k
    assert not set(pairs) & {frozenset(pair) for pair in paired}
    counts = Counter(each.selector for each in chosen)
    assert abs(counts["uniform"] - k * share) < 1 + 1e-9
    assert counts["uniform"] + counts["disagreement"] == k


def test_the_share_holds_where_fewer_pairs_are_left_than_wanted():
    view = SegmentView(scores=VIEW.scores[:, :5])
    chosen = controlled(0.5).choose(range(5), [], 1000, view)
    assert Counter(each.selector for each in chosen) == {"uniform": 5, "disagreement": 5}


def test_the_first_round_is_uniform_and_says_so():
    chosen = controlled(0.0).choose(range(30), [], 12)
    assert [each.selector for each in chosen] == ["uniform"] * 12
    assert [each.pair for each in chosen] == UniformSelector(np.random.default_rng(0)).select(range(30), [], 12)


@pytest.mark.parametrize(("share", "name"), [(0.0, "disagreement"), (1.0, "uniform")])
def test_all_or_none_may_be_control(share, name):
    assert {each.selector for each in controlled(share).choose(range(30), [], 9, VIEW)} == {name}


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_that_is_none_is_refused(share):
    with pytest.raises(InvalidConfig):
        controlled(share).choose(range(30), [], 3, VIEW)
