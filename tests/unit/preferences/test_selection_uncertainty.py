import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import MissingView, NotFinite, ShapeError
from mapt.preferences.selection import SegmentView, make_selector
from mapt.preferences.selection.narrowing import CANDIDATES_PER_QUERY
from mapt.preferences.selection.uncertainty import disagreement, entropy


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
