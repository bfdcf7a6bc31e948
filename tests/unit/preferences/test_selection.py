from collections import Counter
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import InvalidConfig, UnknownSelector
from mapt.preferences.selection import (
    ControlledSelector,
    SegmentView,
    SelectorName,
    UniformSelector,
    control_count,
    make_selector,
    needs_ensemble,
    needs_features,
    needs_view,
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


def test_earlier_pairs_of_segments_not_offered_are_ignored():
    assert len(selector().select([1, 2], [(8, 9), (1, 9)], 5)) == 1


# Drawing three of six pairs lists all of them; drawing one of six uses rejection.
@pytest.mark.parametrize(("n_segments", "k"), [(4, 1), (4, 3)])
def test_pairs_and_their_order_are_uniform(n_segments, k):
    draws = Counter(pair for seed in range(2400 // k) for pair in selector(seed).select(range(n_segments), [(0, 3)], k))
    assert len(draws) == 10
    # Binomial with mean 240 and standard deviation 14.7: five of them.
    assert all(abs(count - 240) < 74 for count in draws.values())


@every_selector
def test_both_orders_are_equally_likely(name):
    ids = range(60)
    chosen = make_selector(name, np.random.default_rng(0)).select(ids, [], 150, random_view(60))
    # Binomial with mean 75 and standard deviation 6.1: five of them.
    assert abs(sum(first < second for first, second in chosen) - 75) < 31


@every_selector
def test_same_seed_gives_the_same_pairs(name):
    ids, paired = list(range(30)), {(0, 1), (4, 2)}

    def chosen(seed):
        return make_selector(name, np.random.default_rng(seed)).select(ids, paired, 10, random_view(30))

    assert chosen(3) == chosen(3)
    assert chosen(3) != chosen(4)


def test_name_of_a_selector_is_its_name_in_make_selector():
    assert [make_selector(name, np.random.default_rng(0)).name for name in selector_names()] == list(selector_names())


def test_unknown_name_is_refused_with_the_known_ones():
    name: SelectorName = "random"  # type: ignore[assignment]
    with pytest.raises(UnknownSelector) as refused:
        make_selector(name, np.random.default_rng(0))
    assert refused.value.name == "random"
    assert refused.value.known == selector_names()


def test_selectors_declare_whether_they_need_scores_or_features():
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
    assert {name for name in selector_names() if not needs_view(name)} == {"uniform", "recent"}


VIEW = SegmentView(scores=np.random.default_rng(0).normal(size=(3, 30)))


def controlled(share, seed=0):
    rng = np.random.default_rng(seed)
    return ControlledSelector(make_selector("disagreement", rng), UniformSelector(rng), share, rng)


@given(st.integers(0, 50), st.floats(0, 1), st.integers(0, 2**16))
def test_number_of_control_pairs_is_less_than_one_off_the_share(k, share, seed):
    n_control = control_count(k, share, np.random.default_rng(seed))
    assert 0 <= n_control <= k
    assert abs(n_control - k * share) < 1 + 1e-9


@pytest.mark.parametrize(("k", "share"), [(1, 0.2), (3, 0.2), (7, 0.35), (10, 0.1)])
def test_control_share_is_exact_on_average(k, share):
    rng = np.random.default_rng(1)
    rounds = 20_000
    total = sum(control_count(k, share, rng) for _ in range(rounds))
    # A rounded number has a standard deviation of at most 1/2: five standard errors of the mean.
    assert abs(total / rounds - k * share) < 5 * 0.5 / np.sqrt(rounds)


@given(
    st.integers(0, 40),
    st.floats(0, 1),
    st.integers(0, 2**16),
    st.sets(st.tuples(st.integers(0, 29), st.integers(0, 29))),
)
def test_controlled_pairs_are_new_and_record_their_selector(k, share, seed, paired):
    paired = {pair for pair in paired if pair[0] != pair[1]}
    chosen = controlled(share, seed).choose(range(30), paired, k, VIEW)
    pairs = [frozenset(each.pair) for each in chosen]
    assert len(set(pairs)) == len(pairs) == k
    assert not set(pairs) & {frozenset(pair) for pair in paired}
    counts = Counter(each.selector for each in chosen)
    assert abs(counts["uniform"] - k * share) < 1 + 1e-9
    assert counts["uniform"] + counts["disagreement"] == k


def test_control_share_holds_if_fewer_pairs_are_left_than_requested():
    view = SegmentView(scores=VIEW.scores[:, :5])
    chosen = controlled(0.5).choose(range(5), [], 1000, view)
    assert Counter(each.selector for each in chosen) == {"uniform": 5, "disagreement": 5}


def test_without_a_view_all_pairs_are_control_pairs():
    chosen = controlled(0.0).choose(range(30), [], 12)
    assert [each.selector for each in chosen] == ["uniform"] * 12
    assert [each.pair for each in chosen] == UniformSelector(np.random.default_rng(0)).select(range(30), [], 12)


def test_a_view_of_the_first_segments_limits_informed_pairs_only():
    view = SegmentView(scores=VIEW.scores[:, :5])
    chosen = controlled(0.5).choose(range(30), [], 16, view)
    informed = {segment for each in chosen if each.selector == "disagreement" for segment in each.pair}
    control = {segment for each in chosen if each.selector == "uniform" for segment in each.pair}
    assert informed <= set(range(5))
    assert len(control - set(range(5))) > 5


@pytest.mark.parametrize(("share", "name"), [(0.0, "disagreement"), (1.0, "uniform")])
def test_control_share_may_be_zero_or_one(share, name):
    assert {each.selector for each in controlled(share).choose(range(30), [], 9, VIEW)} == {name}


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_control_share_outside_zero_to_one_is_refused(share):
    with pytest.raises(InvalidConfig):
        controlled(share).choose(range(30), [], 3, VIEW)


SEGMENTS, DIMENSIONS, MEMBERS = 400, 40, 3
FIRST, BATCH, LABELS, SEEDS = 20, 20, 160, 6


def fitted(differences, labels, weights):
    """Weights (M, F) after gradient descent on the Bradley-Terry loss of feature differences (P, F)."""
    for _ in range(150):
        excess = 1 / (1 + np.exp(-np.clip(differences @ weights.T, -30, 30))) - labels[:, None]
        weights = weights - 0.3 * (excess.T @ differences / len(labels) + 1e-3 * weights)
    return weights


def accuracy_of(name, seed):
    """Test accuracy of the ensemble mean after LABELS oracle labels."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(SEGMENTS, DIMENSIONS))
    returns = features @ (rng.normal(size=DIMENSIONS) * np.geomspace(0.1, 1, DIMENSIONS))
    start = rng.normal(size=(MEMBERS, DIMENSIONS))
    selector = ControlledSelector(make_selector(name, rng), UniformSelector(rng), 0.2, rng)
    queried, view = [], None
    while len(queried) < LABELS:
        k = FIRST if view is None else BATCH
        queried += [chosen.pair for chosen in selector.choose(range(SEGMENTS), queried, k, view)]
        first, second = np.array(queried).T
        weights = fitted(features[first] - features[second], (returns[first] > returns[second]) * 1.0, start)
        view = SegmentView(weights @ features.T, features)
    first, second = rng.integers(SEGMENTS, size=(2, 4000))
    scores = view.scores.mean(axis=0)
    decided = first != second
    return ((scores[first] > scores[second]) == (returns[first] > returns[second]))[decided].mean()


@pytest.mark.parametrize("name", ["disagreement", "entropy"])
def test_uncertainty_sampling_beats_uniform_sampling(name):
    gains = [accuracy_of(name, seed) - accuracy_of("uniform", seed) for seed in range(SEEDS)]
    # Paired over seeds: at least two points of accuracy, and three standard errors.
    assert np.mean(gains) > 0.02
    assert np.mean(gains) > 3 * np.std(gains, ddof=1) / np.sqrt(SEEDS)
