import math
from itertools import combinations_with_replacement

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import MissingView, NotFinite, ShapeError
from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.selection import SegmentView, make_selector, segment_features
from mapt.preferences.selection.criteria import disagreement, entropy, k_center
from mapt.preferences.selection.selectors import CANDIDATES_PER_QUERY

pytestmark = pytest.mark.numerics


def slow_probabilities(scores, first, second):
    return [1 / (1 + math.exp(-(member[first] - member[second]))) for member in scores]


def slow_disagreement(scores, first, second):
    p = slow_probabilities(scores, first, second)
    mean = sum(p) / len(p)
    return math.sqrt(sum((each - mean) ** 2 for each in p) / len(p))


def slow_entropy(scores, first, second):
    p = slow_probabilities(scores, first, second)
    return sum(-each * math.log(each) - (1 - each) * math.log(1 - each) for each in p) / len(p)


@pytest.mark.parametrize(("fast", "slow"), [(disagreement, slow_disagreement), (entropy, slow_entropy)])
@given(st.integers(1, 5), st.integers(2, 8), st.integers(0, 2**16))
def test_measures_equal_a_plain_loop(fast, slow, members, n_segments, seed):
    rng = np.random.default_rng(seed)
    scores = (4 * rng.normal(size=(members, n_segments))).astype(np.float32)
    pairs = rng.integers(n_segments, size=(10, 2))
    expected = [slow(scores.astype(float).tolist(), first, second) for first, second in pairs]
    np.testing.assert_allclose(fast(scores, pairs), expected, rtol=1e-9, atol=1e-12)


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_large_scores_give_finite_measures_that_do_not_depend_on_the_order(a, b):
    scores = np.array([[a, 0.0], [b, 0.0]])
    pairs = np.array([[0, 1], [1, 0]])
    assert 0 <= disagreement(scores, pairs)[0] <= 0.5
    assert -1e-12 <= entropy(scores, pairs)[0] <= math.log(2) + 1e-12
    for measure in (disagreement, entropy):
        forward, backward = measure(scores, pairs)
        assert forward == pytest.approx(backward, abs=1e-9)


def odd_segments(n_odd=6, n_segments=40):
    """Two members agree on all segments but the last few, which the one thinks best and the other worst."""
    scores = np.tile(np.linspace(-1, 1, n_segments), (2, 1))
    scores[0, -n_odd:], scores[1, -n_odd:] = 20, -20
    return SegmentView(scores=scores), set(range(n_segments - n_odd, n_segments))


def test_disagreement_asks_what_the_members_disagree_about():
    view, odd = odd_segments()
    for seed in range(20):
        chosen = make_selector("disagreement", np.random.default_rng(seed)).select(range(40), [], 5, view)
        # one of them against one that both know: of two of them, each member is as unsure as the other
        assert all(len(set(pair) & odd) == 1 for pair in chosen)


def test_entropy_asks_about_pairs_that_every_member_takes_for_alike():
    view, odd = odd_segments()
    chosen = make_selector("entropy", np.random.default_rng(0)).select(range(40), [], 10, view)
    assert all(set(pair).isdisjoint(odd) or set(pair) <= odd for pair in chosen)
    gaps = [abs(first - second) for first, second in chosen if first not in odd]
    assert max(gaps) < 10


def test_the_most_uncertain_of_ten_times_as_many_candidates_are_asked():
    view = SegmentView(scores=np.random.default_rng(1).normal(size=(3, 50)))
    k = 7
    candidates = make_selector("uniform", np.random.default_rng(5)).select(range(50), [], CANDIDATES_PER_QUERY * k)
    chosen = make_selector("disagreement", np.random.default_rng(5)).select(range(50), [], k, view)
    ranked = sorted(candidates, key=lambda pair: -disagreement(view.scores, np.array([pair]))[0])
    assert chosen == ranked[:k]


@pytest.mark.parametrize(
    ("name", "view", "what"),
    [
        ("disagreement", None, "scores"),
        ("entropy", SegmentView(features=np.zeros((9, 2))), "scores"),
        ("k_center", SegmentView(scores=np.zeros((2, 9))), "features"),
        ("disagreement_k_center", SegmentView(scores=np.zeros((2, 9))), "features"),
    ],
)
def test_a_selector_that_is_told_too_little_says_what_it_needs(name, view, what):
    with pytest.raises(MissingView, match=what):
        make_selector(name, np.random.default_rng(0)).select(range(9), [], 2, view)


def test_a_view_of_other_segments_is_refused():
    with pytest.raises(ShapeError, match="scores"):
        make_selector("entropy", np.random.default_rng(0)).select(range(9), [], 2, SegmentView(scores=np.zeros((2, 8))))
    with pytest.raises(ShapeError, match="features"):
        make_selector("k_center", np.random.default_rng(0)).select(
            range(9), [], 2, SegmentView(features=np.ones((8, 2)))
        )


@pytest.mark.parametrize(
    ("arrays", "error", "words"),
    [
        ({"scores": np.zeros(4)}, ShapeError, "scores"),
        ({"scores": np.array([[0.0, np.nan]])}, NotFinite, "scores of segment 1"),
        ({"features": np.zeros((3, 2)), "asked": np.zeros((5, 2, 3))}, ShapeError, "asked"),
        ({"features": np.array([[0.0], [np.inf]])}, NotFinite, "features of segment 1"),
    ],
)
def test_a_view_that_cannot_be_used_is_refused(arrays, error, words):
    with pytest.raises(error, match=words):
        SegmentView(**arrays)


def slow_distance(pair, other):
    straight = ((pair[0] - other[0]) ** 2).sum() + ((pair[1] - other[1]) ** 2).sum()
    crossed = ((pair[0] - other[1]) ** 2).sum() + ((pair[1] - other[0]) ** 2).sum()
    return min(straight, crossed)


def slow_k_center(candidates, asked, k):
    chosen = []
    centres = list(asked)
    while len(chosen) < min(k, len(candidates)):
        rest = [place for place in range(len(candidates)) if place not in chosen]
        if centres:
            rest.sort(key=lambda place: -min(slow_distance(candidates[place], centre) for centre in centres))
        chosen.append(rest[0])
        centres.append(candidates[rest[0]])
    return chosen


@given(st.integers(0, 14), st.integers(0, 6), st.integers(0, 16), st.integers(0, 2**16))
def test_k_center_equals_a_plain_loop(n_candidates, n_asked, k, seed):
    rng = np.random.default_rng(seed)
    candidates, asked = rng.normal(size=(n_candidates, 2, 3)), rng.normal(size=(n_asked, 2, 3))
    assert k_center(candidates, asked, k).tolist() == slow_k_center(candidates, asked, k)


@given(st.integers(0, 2**16))
def test_which_segment_comes_first_makes_no_difference(seed):
    rng = np.random.default_rng(seed)
    candidates, asked = rng.normal(size=(12, 2, 3)), rng.normal(size=(4, 2, 3))
    turned = candidates.copy()
    turned[::2] = turned[::2, ::-1]
    assert k_center(candidates, asked, 6).tolist() == k_center(turned, asked[:, ::-1], 6).tolist()


def test_asked_pairs_beyond_one_chunk_count_too(monkeypatch):
    rng = np.random.default_rng(0)
    candidates, asked = rng.normal(size=(12, 2, 3)), rng.normal(size=(50, 2, 3))
    whole = k_center(candidates, asked, 6).tolist()
    monkeypatch.setattr("mapt.preferences.selection.criteria._CHUNK_PAIRS", 7)
    assert k_center(candidates, asked, 6).tolist() == whole == slow_k_center(candidates, asked, 6)


def clusters(n_clusters=4, each=10):
    """Segments in tight, far clusters; which one each is of."""
    rng = np.random.default_rng(0)
    centres = 100 * np.eye(n_clusters)
    of = np.repeat(np.arange(n_clusters), each)
    return centres[of] + 0.1 * rng.normal(size=(len(of), n_clusters)), of


def kinds(pairs, of):
    return {tuple(sorted((int(of[first]), int(of[second])))) for first, second in pairs}


def test_k_center_covers_every_pair_of_clusters_before_any_twice():
    features, of = clusters()
    every = set(combinations_with_replacement(range(4), 2))
    for seed in range(10):
        chosen = make_selector("k_center", np.random.default_rng(seed)).select(
            range(40), [], len(every), SegmentView(features=features)
        )
        assert kinds(chosen, of) == every


def test_k_center_keeps_away_from_what_was_asked():
    features, of = clusters()
    inside = [(first, second) for first in range(10) for second in range(first)]
    view = SegmentView(features=features)
    for seed in range(10):
        chosen = make_selector("k_center", np.random.default_rng(seed)).select(range(40), inside[:5], 9, view)
        assert (0, 0) not in kinds(chosen, of)


def test_k_center_keeps_away_from_asked_pairs_of_segments_not_offered():
    features, of = clusters()
    asked = np.stack((features[:5], features[5:10]), axis=1)
    view = SegmentView(features=features, asked=asked)
    for seed in range(10):
        chosen = make_selector("k_center", np.random.default_rng(seed)).select(range(40), [], 9, view)
        assert (0, 0) not in kinds(chosen, of)


def test_the_unit_of_a_feature_makes_no_difference():
    features, _ = clusters()
    units = np.array([1e-3, 1.0, 50.0, 1e4])

    def chosen(features):
        return make_selector("k_center", np.random.default_rng(2)).select(
            range(40), [], 8, SegmentView(features=features)
        )

    assert chosen(features) == chosen(features * units)


def test_copies_of_one_segment_are_still_chosen_when_more_are_wanted():
    view = SegmentView(features=np.zeros((5, 3)))
    chosen = make_selector("k_center", np.random.default_rng(0)).select(range(5), [], 10, view)
    assert len({frozenset(pair) for pair in chosen}) == 10


@pytest.mark.parametrize("name", ["disagreement_k_center", "entropy_k_center"])
def test_the_combinations_spread_out_among_the_more_uncertain_half(name):
    features, of = clusters()
    rng = np.random.default_rng(3)
    # The members differ on clusters 2 and 3 alone, by which entropy is high as well.
    scores = np.tile(10.0 * of, (2, 1)) + np.where(of < 2, 0.0, 1.0) * rng.normal(scale=8.0, size=(2, 40))
    view = SegmentView(scores=scores, features=features)
    # as many as there are candidates: all 780 pairs; the uncertain half of them is 390
    chosen = make_selector(name, np.random.default_rng(0)).select(range(40), [], 78, view)
    measures = disagreement(scores, np.array(chosen))
    everything = disagreement(scores, np.array([(a, b) for a in range(40) for b in range(a)]))
    if name.startswith("disagreement"):
        assert measures.min() >= np.median(everything)
    spread = make_selector(name, np.random.default_rng(0)).select(range(40), [], 4, view)
    assert len(kinds(spread, of)) >= 3


def test_features_say_where_a_team_is_and_how_much_it_moves_whatever_the_phase():
    rng = np.random.default_rng(0)
    steps = np.arange(40)
    gait = np.sin(2 * np.pi * steps / 10)[:, None, None] * rng.normal(size=(1, 3, 2))
    later = np.roll(gait, 5, axis=0)
    still = np.zeros_like(gait)
    actions = [np.zeros((40, 3, 1))] * 3
    features = segment_features(SegmentArrays.stack([gait, later, still], actions))
    assert features.shape == (3, 2 * 3 * (2 + 1))
    np.testing.assert_allclose(features[0], features[1], atol=1e-6)
    assert np.abs(features[0] - features[2]).max() > 0.1


def test_padding_does_not_count_as_a_feature():
    rng = np.random.default_rng(0)
    short, long = rng.normal(size=(4, 2, 3)), rng.normal(size=(9, 2, 3))
    acted = rng.normal(size=(9, 2, 1))
    together = segment_features(SegmentArrays.stack([short, long], [acted[:4], acted]))
    alone = segment_features(SegmentArrays.stack([short], [acted[:4]]))
    np.testing.assert_allclose(together[0], alone[0], rtol=1e-6)
    everything = np.concatenate((short, acted[:4]), axis=2).reshape(4, -1)
    np.testing.assert_allclose(alone[0], np.concatenate((everything.mean(0), everything.std(0))), rtol=1e-5)
