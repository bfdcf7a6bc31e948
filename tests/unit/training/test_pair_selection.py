from collections import Counter
from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from mapt.errors import UnknownSelector
from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.selection import SegmentView, segment_features, selector_names
from mapt.training.pair_selection import (
    RECENT_CANDIDATES,
    SegmentScorer,
    candidate_limit,
    choose_pairs,
    newest_pairs,
)


def choose(ids, paired, k, selector, *, control_share=0.2, view=None, first_round=False, seed=0):
    return choose_pairs(
        ids,
        paired,
        k,
        selector=selector,
        control_share=control_share,
        view=view,
        first_round=first_round,
        rng=np.random.default_rng(seed),
    )


def pairs_of(chosen, selector):
    """The pairs that this selector chose."""
    return [each.pair for each in chosen if each.selector == selector]


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
    # the view may cover only some of the segments
    view = view_of(max(2, n_segments // 2)) if has_view and not first_round else None
    chosen = choose(ids, paired, k, name, view=view, first_round=first_round, seed=seed)
    unordered = {frozenset(each.pair) for each in chosen}
    assert len(unordered) == len(chosen)
    assert all(len(pair) == 2 for pair in unordered)
    assert not unordered & paired
    n_available = n_segments * (n_segments - 1) // 2 - len(paired)
    assert len(chosen) == min(k, n_available)


#: more than `FEWEST_RECENT`, so that `recent` does not choose uniformly
N_SEGMENTS = 24
PAIRED = {frozenset(pair) for pair in pairwise(range(N_SEGMENTS))}


def uniformity(select):
    """p value of the chi-square test that `select(seed)` chooses each of the segments' 253 new pairs equally often.

    Each call must choose one pair, so that the choices are independent.
    """
    every = [frozenset(pair) for pair in combinations(range(N_SEGMENTS), 2) if frozenset(pair) not in PAIRED]
    n_draws = 10 * len(every)
    counts = Counter(frozenset(pair) for seed in range(n_draws) for pair in select(seed))
    assert sum(counts.values()) == sum(counts[pair] for pair in every) == n_draws
    return stats.chisquare([counts[pair] for pair in every]).pvalue


def test_uniform_chooses_every_new_pair_equally_often_in_every_round():
    def select(first_round):
        return lambda seed: pairs_of(
            choose(range(N_SEGMENTS), PAIRED, 1, "uniform", first_round=first_round, seed=seed), "uniform"
        )

    assert uniformity(select(first_round=False)) > 0.01
    assert uniformity(select(first_round=True)) > 0.01


def test_recent_does_not_choose_uniformly():
    assert uniformity(lambda seed: pairs_of(choose(range(N_SEGMENTS), PAIRED, 1, "recent", seed=seed), "recent")) < 1e-9


@pytest.mark.parametrize("name", ["recent", "disagreement"])
def test_first_round_is_uniform_whatever_the_selector(name):
    def select(seed):
        return pairs_of(choose(range(N_SEGMENTS), PAIRED, 1, name, first_round=True, seed=seed), "uniform")

    assert uniformity(select) > 0.01


def test_control_pairs_are_uniform_over_all_new_pairs():
    # The selector sees only the newest segments, and chooses one of the two pairs.
    view = view_of(N_SEGMENTS // 2)

    def select(seed):
        chosen = choose(range(N_SEGMENTS), PAIRED, 2, "disagreement", control_share=0.5, view=view, seed=seed)
        return pairs_of(chosen, "uniform")

    assert uniformity(select) > 0.01


def test_without_a_view_an_informed_selector_chooses_uniformly():
    assert (
        uniformity(lambda seed: pairs_of(choose(range(N_SEGMENTS), PAIRED, 1, "entropy", seed=seed), "uniform")) > 0.01
    )


def test_uniform_chooses_from_all_segments_and_recent_from_the_newest():
    assert candidate_limit("uniform") is candidate_limit("disagreement") is None
    assert candidate_limit("recent") == RECENT_CANDIDATES


def test_the_newest_quarter_has_a_quarter_of_the_places_of_uniform_and_most_of_those_of_recent():
    # All segments have a query, or recent pairs would begin with those that have none.
    ids, n_pairs = range(400), 1000
    queried = {frozenset((segment, segment + 1)) for segment in range(0, 400, 2)}
    newest = {
        name: sum(segment < 100 for pair in pairs_of(choose(ids, queried, n_pairs, name), name) for segment in pair)
        for name in ("uniform", "recent")
    }
    # Binomial with n = 2000: five standard deviations.
    assert abs(newest["uniform"] - 500) < 5 * np.sqrt(2000 * 0.25 * 0.75)
    # Half of the pairs have two recent segments, the other half one, and another one in a quarter of the cases.
    assert newest["recent"] / 2000 == pytest.approx(0.5 + 0.25 * 1.25, abs=0.03)


def test_every_pair_of_recent_has_a_recent_segment():
    ids = [f"seg_{index}" for index in range(400)]
    recent = set(ids[:100])
    pairs = pairs_of(choose(ids, set(), 200, "recent"), "recent")
    assert all(set(pair) & recent for pair in pairs)
    assert 100 <= sum(set(pair) <= recent for pair in pairs) < 200


def test_recent_pairs_take_segments_without_a_query_first():
    queried = {frozenset((segment, segment + 1)) for segment in range(0, 100, 2)}
    pairs = pairs_of(choose(range(400), queried, 80, "recent"), "recent")
    # Of the hundred recent segments, none is without a query: the pairs need one, and take any.
    assert all(min(pair) < 100 for pair in pairs)
    queried = {frozenset((segment, segment + 1)) for segment in range(0, 400, 4)}
    pairs = pairs_of(choose(range(400), queried, 30, "recent"), "recent")
    counts = Counter(segment for pair in pairs for segment in pair)
    assert set(counts.values()) == {1}
    assert all(segment % 4 >= 2 for segment in counts)
    assert sum(max(pair) < 100 for pair in pairs) >= 15
    # There are 50 such recent segments, so that the 30th pair to have one is the last.
    pairs = pairs_of(choose(range(400), queried, 60, "recent"), "recent")
    assert len(set(map(frozenset, pairs))) == 60


def test_pairs_chosen_a_few_at_a_time_share_few_segments():
    """As in the service: four segments are stored per label, and queries are created a few at a time."""
    ids, paired = list[int](), set[frozenset[int]]()
    for number in range(200):
        ids = [*range(4 * number + 3, 4 * number - 1, -1), *ids]
        if number >= 16:
            paired |= {frozenset(pair) for pair in pairs_of(choose(ids, paired, 1, "recent", seed=number), "recent")}
    counts = Counter(segment for pair in paired for segment in pair)
    assert len(paired) == 184
    assert set(counts.values()) == {1}


def test_uniform_and_recent_ignore_the_control_share():
    assert {each.selector for each in choose(range(40), set(), 20, "recent", control_share=1.0)} == {"recent"}
    assert {each.selector for each in choose(range(40), set(), 20, "uniform", control_share=0.0)} == {"uniform"}


def test_a_selector_chooses_among_the_segments_of_its_view_and_each_pair_names_its_selector():
    ids = [f"seg_{index}" for index in range(400)]
    chosen = choose(ids, set(), 40, "disagreement", control_share=0.25, view=view_of(100))
    assert Counter(each.selector for each in chosen) == {"uniform": 10, "disagreement": 30}
    informed = pairs_of(chosen, "disagreement")
    assert {id for pair in informed for id in pair} <= set(ids[:100])
    # The candidate pairs are those of `recent`: each has at least one recent segment of the view.
    assert all(set(pair) & set(ids[:25]) for pair in informed)


def test_uniform_pairs_fill_a_round_that_exhausts_the_pairs_of_the_view():
    chosen = choose(range(20), set(), 30, "k_center", control_share=0.0, view=view_of(5))
    assert Counter(each.selector for each in chosen) == {"uniform": 20, "k_center": 10}


def test_an_unknown_selector_is_refused():
    with pytest.raises(UnknownSelector):
        choose(["a", "b"], [], 1, "boredom", first_round=True)


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
