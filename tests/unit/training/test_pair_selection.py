from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import UnknownSelector
from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.selection import SegmentView, segment_features, selector_names
from mapt.training.pair_selection import SegmentScorer, choose_pairs, newest_pairs


def uniform_pairs(ids, paired, k, *, first_round=False, seed=0):
    chosen = choose_pairs(
        ids,
        paired,
        k,
        selector="uniform",
        control_share=0.2,
        view=None,
        first_round=first_round,
        rng=np.random.default_rng(seed),
    )
    assert {each.selector for each in chosen} <= {"uniform"}
    return [each.pair for each in chosen]


def view_of(n_segments, seed=0):
    rng = np.random.default_rng(seed)
    return SegmentView(rng.normal(size=(3, n_segments)), rng.normal(size=(n_segments, 4)), rng.normal(size=(7, 2, 4)))


@pytest.mark.parametrize("name", selector_names())
@given(st.integers(2, 60), st.integers(1, 30), st.booleans(), st.booleans(), st.integers(0, 2**32))
def test_pairs_are_new_and_distinct_and_as_many_as_requested_or_available(
    name, n_segments, k, first_round, has_view, seed
):
    ids = [f"seg_{index}" for index in range(n_segments)]
    paired = {frozenset(pair) for pair in pairwise(ids)}
    chosen = choose_pairs(
        ids,
        paired,
        k,
        selector=name,
        control_share=0.2,
        # the view may cover only some of the segments
        view=view_of(max(2, n_segments // 2)) if has_view and not first_round else None,
        first_round=first_round,
        rng=np.random.default_rng(seed),
    )
    unordered = {frozenset(each.pair) for each in chosen}
    assert len(unordered) == len(chosen)
    assert all(len(pair) == 2 for pair in unordered)
    assert not unordered & paired
    n_available = n_segments * (n_segments - 1) // 2 - len(paired)
    assert len(chosen) == min(k, n_available)


def test_every_pair_of_a_later_round_has_a_recent_segment():
    ids = [f"seg_{index}" for index in range(400)]
    recent = set(ids[:100])
    pairs = uniform_pairs(ids, set(), 200)
    assert all(set(pair) & recent for pair in pairs)
    assert 100 <= sum(set(pair) <= recent for pair in pairs) < 200


def test_first_round_samples_from_all_segments():
    ids = [f"seg_{index}" for index in range(400)]
    pairs = uniform_pairs(ids, set(), 200, first_round=True)
    assert len({id for pair in pairs for id in pair} & set(ids[100:])) > 150


def test_both_orders_of_a_pair_are_equally_likely():
    ids = [f"seg_{index:03}" for index in range(400)]
    pairs = uniform_pairs(ids, set(), 1000)
    assert 400 < sum(first < second for first, second in pairs) < 600


def test_the_same_seed_gives_the_same_pairs():
    ids = [f"seg_{index}" for index in range(50)]
    first, second = (uniform_pairs(ids, set(), 9, seed=3) for _ in range(2))
    assert first == second


def test_a_selector_chooses_among_the_segments_of_its_view_and_each_pair_names_its_selector():
    ids = [f"seg_{index}" for index in range(400)]
    chosen = choose_pairs(
        ids,
        set(),
        40,
        selector="disagreement",
        control_share=0.25,
        view=view_of(100),
        first_round=False,
        rng=np.random.default_rng(0),
    )
    assert Counter(each.selector for each in chosen) == {"uniform": 10, "disagreement": 30}
    assert {id for each in chosen for id in each.pair} <= set(ids[:100])
    # candidates are sampled like uniform pairs: each has at least one recent segment
    recent = set(ids[:25])
    assert all(set(each.pair) & recent for each in chosen)


def test_an_unknown_selector_is_refused():
    with pytest.raises(UnknownSelector):
        choose_pairs(
            ["a", "b"],
            [],
            1,
            selector="boredom",  # pyright: ignore[reportArgumentType]
            control_share=0.2,
            view=None,
            first_round=True,
            rng=np.random.default_rng(0),
        )


class CountedSegments:
    """Random segments, with a count of how often each was read."""

    def __init__(self, n_segments: int) -> None:
        rng = np.random.default_rng(0)
        shape = (n_segments, 7, 2)
        self.all = SegmentArrays(
            rng.normal(size=(*shape, 5)).astype(np.float32),
            rng.normal(size=(*shape, 3)).astype(np.float32),
            np.ones((n_segments, 7), dtype=np.bool_),
        )
        self.reads: Counter[int] = Counter()

    def read(self, indices) -> SegmentArrays:
        self.reads.update(indices)
        return self.all.take(indices)


def sum_scores(segments: SegmentArrays) -> np.ndarray:
    """Scores (2, S) of an ensemble with two members."""
    return np.stack([segments.observations.sum(axis=(1, 2, 3)), segments.actions.sum(axis=(1, 2, 3))])


def test_scores_and_features_keep_the_order_of_the_segments():
    segments = CountedSegments(70)
    order = np.random.default_rng(1).permutation(70).tolist()
    view = SegmentScorer(segments.read).view(order, "1", sum_scores, [(order[0], order[1]), (order[1], order[5])])
    assert view.scores is not None
    assert view.features is not None
    assert view.queried is not None
    np.testing.assert_array_equal(view.scores, sum_scores(segments.all)[:, order])
    np.testing.assert_allclose(view.features, segment_features(segments.all)[order], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(view.queried, view.features[[[0, 1], [1, 5]]])


def test_each_segment_is_read_once_per_version_and_once_for_its_features():
    segments = CountedSegments(6)
    scorer = SegmentScorer(segments.read)
    scorer.scores(range(4), "1", sum_scores)
    scorer.scores(range(6), "1", sum_scores)
    assert set(segments.reads.values()) == {1}
    scorer.scores(range(6), "2", sum_scores)
    assert set(segments.reads.values()) == {2}
    scorer.features([0, 1, 0])
    scorer.features(range(6))
    assert set(segments.reads.values()) == {3}


def test_newest_pairs_are_ordered_by_their_newest_segment():
    pairs = {frozenset(pair) for pair in [("a", "d"), ("c", "b"), ("d", "c")]}
    assert newest_pairs(pairs) == [("b", "c"), ("a", "d"), ("c", "d")]
