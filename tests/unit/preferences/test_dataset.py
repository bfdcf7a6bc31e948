import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import (
    InvalidAgent,
    InvalidLabel,
    InvalidMask,
    InvalidPair,
    InvalidWeight,
    NotEnoughPairs,
    NotFinite,
    ShapeError,
)
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays


def segments(n_segments=4, n_steps=3, n_agents=2, observation_dim=5, action_dim=1):
    rng = np.random.default_rng(0)
    return SegmentArrays(
        rng.normal(size=(n_segments, n_steps, n_agents, observation_dim)).astype(np.float32),
        rng.normal(size=(n_segments, n_steps, n_agents, action_dim)).astype(np.float32),
        np.ones((n_segments, n_steps), dtype=np.bool_),
    )


def dataset(n_pairs):
    first = np.arange(n_pairs) % 4
    return PreferenceDataset(segments(), np.stack((first, (first + 1) % 4), axis=1), np.arange(n_pairs) % 2)


def test_segments_report_their_dimensions():
    arrays = segments(n_segments=4, n_steps=3, n_agents=2, observation_dim=5, action_dim=1)
    dimensions = (arrays.n_steps, arrays.n_agents, arrays.observation_dim, arrays.action_dim)
    assert (len(arrays), *dimensions) == (4, 3, 2, 5, 1)


def test_segments_of_different_lengths_are_padded_at_the_end():
    lengths = (2, 4)
    arrays = SegmentArrays.stack([np.full((t, 3, 2), 7.0) for t in lengths], [np.full((t, 3, 1), 8.0) for t in lengths])
    assert arrays.mask.tolist() == [[True, True, False, False], [True] * 4]
    assert (arrays.observations[arrays.mask] == 7).all()
    assert (arrays.observations[~arrays.mask] == 0).all()
    assert (arrays.actions[arrays.mask] == 8).all()


@pytest.mark.parametrize(
    ("observations", "actions", "name"),
    [
        ([(3, 2, 5)], [(4, 2, 1)], "actions"),
        ([(3, 2, 5), (3, 1, 5)], [(3, 2, 1)] * 2, "observations"),
        ([(3, 5)], [(3, 1)], "observations"),
        ([], [], "segments"),
    ],
)
def test_stacking_refuses_segments_of_different_dimensions(observations, actions, name):
    with pytest.raises(ShapeError) as refused:
        SegmentArrays.stack([np.zeros(shape) for shape in observations], [np.zeros(shape) for shape in actions])
    assert refused.value.name == name


@pytest.mark.parametrize(("name", "part"), [("observations", np.s_[0]), ("actions", np.s_[:, :2]), ("mask", np.s_[:2])])
def test_array_with_the_wrong_shape_is_named(name, part):
    whole = segments()
    arrays = {each: getattr(whole, each) for each in ("observations", "actions", "mask")}
    with pytest.raises(ShapeError) as refused:
        SegmentArrays(**arrays | {name: arrays[name][part]})
    assert refused.value.name == name


@pytest.mark.parametrize("mask", [[False, True, True], [True, False, True], [False] * 3])
def test_padding_anywhere_but_at_the_end_is_refused(mask):
    whole = segments()
    broken = whole.mask.copy()
    broken[2] = mask
    with pytest.raises(InvalidMask) as refused:
        SegmentArrays(whole.observations, whole.actions, broken)
    assert refused.value.segment == 2


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_and_infinity_are_refused(value):
    whole = segments()
    whole.actions[3, 1, 0, 0] = value
    with pytest.raises(NotFinite) as refused:
        SegmentArrays(whole.observations, whole.actions, whole.mask)
    assert (refused.value.name, refused.value.segment) == ("actions", 3)


@pytest.mark.parametrize("label", [-0.1, 1.5, np.nan])
def test_label_outside_zero_to_one_is_refused(label):
    with pytest.raises(InvalidLabel) as refused:
        PreferenceDataset(segments(), np.array([[0, 1], [1, 2]]), np.array([0.5, label]))
    assert refused.value.index == 1


@pytest.mark.parametrize("pair", [(0, 0), (0, 4), (-1, 2)])
def test_pair_must_refer_to_two_existing_segments(pair):
    with pytest.raises(InvalidPair) as refused:
        PreferenceDataset(segments(), np.array([(0, 1), pair]), np.array([1.0, 0.0]))
    assert (refused.value.index, refused.value.pair) == (1, pair)


@pytest.mark.parametrize(("pairs", "name"), [([[0, 1]], "labels"), ([0, 1], "pairs")])
def test_pairs_and_labels_of_different_lengths_are_refused(pairs, name):
    with pytest.raises(ShapeError) as refused:
        PreferenceDataset(segments(), np.array(pairs), np.array([1.0, 0.0]))
    assert refused.value.name == name


def unshared(n_pairs: int, ids=None) -> PreferenceDataset:
    """Pairs that share no segment, all with the label 1."""
    shape = (2 * n_pairs, 1, 1, 1)
    arrays = SegmentArrays(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.ones(shape[:2], np.bool_))
    ids = np.arange(n_pairs) if ids is None else np.asarray(ids)
    return PreferenceDataset(arrays, np.arange(2 * n_pairs).reshape(-1, 2), np.ones(n_pairs), ids)


@given(st.integers(2, 300), st.sampled_from([0.1, 0.2, 0.25, 0.5]), st.integers(0, 5))
def test_split_holds_out_about_its_fraction_and_keeps_every_pair(n_pairs, fraction, seed):
    train, hold_out = unshared(n_pairs).split(fraction, seed)
    assert len(train) >= 1
    assert sorted([*train.ids, *hold_out.ids]) == list(range(n_pairs))
    assert abs(len(hold_out) - fraction * n_pairs) <= 5 * np.sqrt(fraction * n_pairs) + 1


@given(st.lists(st.integers(0, 900), min_size=6, max_size=80, unique=True), st.data(), st.integers(0, 5))
def test_pairs_stay_on_their_side_as_labels_are_added_undone_or_reordered(ids, data, seed):
    some = data.draw(st.permutations(ids))[: max(2, len(ids) // 2)]
    all_held, some_held = (
        dict(zip(each, unshared(len(each), each).held_out(0.3, seed), strict=True)) for each in (ids, some)
    )
    # Unless all pairs are on one side.
    if any(some_held.values()):
        assert some_held == {id: all_held[id] for id in some}


def test_training_pairs_share_no_segment_with_the_hold_out():
    rng = np.random.default_rng(0)
    pairs = np.array([rng.choice(400, 2, replace=False) for _ in range(300)])
    arrays = unshared(200).segments
    whole = PreferenceDataset(arrays, pairs, np.ones(300))
    train, hold_out = whole.split(0.2, 0)
    assert not np.isin(train.pairs, hold_out.pairs).any()
    assert set(hold_out.ids) == set(np.flatnonzero(whole.held_out(0.2, 0)))
    assert 120 <= len(train) < 300 - len(hold_out)


def test_few_segments_are_shared_rather_than_left_out():
    train, hold_out = dataset(100).split(0.2, 0)
    assert len(train) + len(hold_out) == 100


def test_folds_are_even_and_independent_of_the_hold_out():
    whole = unshared(4000)
    folds, held_out = whole.folds(4, 0), whole.held_out(0.2, 0)
    counts = np.bincount(folds[held_out], minlength=4), np.bincount(folds[~held_out], minlength=4)
    np.testing.assert_allclose(counts[0], 200, atol=60)
    np.testing.assert_allclose(counts[1], 800, atol=120)


def test_ids_of_another_number_are_refused():
    with pytest.raises(ShapeError) as refused:
        PreferenceDataset(unshared(2).segments, np.array([[0, 1]]), np.ones(1), np.arange(2))
    assert refused.value.name == "ids"


def test_pairs_of_two_sets_are_joined():
    whole = unshared(6)
    joined = whole.take([4, 1]).joined(whole.take([0]))
    assert joined.ids.tolist() == [4, 1, 0]
    np.testing.assert_array_equal(joined.pairs, whole.pairs[[4, 1, 0]])


def test_split_depends_on_the_seed():
    first, second = (dataset(100).split(0.2, seed)[1].pairs for seed in (0, 1))
    assert not np.array_equal(first, second)


def test_one_pair_cannot_be_split():
    with pytest.raises(NotEnoughPairs):
        dataset(1).split(0.2, 0)


def test_pairs_keep_their_weights():
    weights = np.linspace(0, 1, 20, dtype=np.float32)
    whole = dataset(20).weighted(weights)
    assert whole.take([3, 5]).weights.tolist() == weights[[3, 5]].tolist()
    assert whole.take([3]).joined(whole.take([5])).weights.tolist() == weights[[3, 5]].tolist()
    assert (dataset(20).weights == 1).all()


@pytest.mark.parametrize("weight", [-0.1, 1.1, float("nan")])
def test_weight_outside_0_to_1_is_refused(weight):
    with pytest.raises(InvalidWeight) as refused:
        dataset(2).weighted([1, weight])
    assert refused.value.index == 1


def test_every_label_needs_a_weight():
    with pytest.raises(ShapeError) as refused:
        dataset(3).weighted([1, 1])
    assert refused.value.name == "weights"


def test_decisive_agents_follow_their_pairs():
    arrays = segments()
    pairs, agents = np.array([[0, 1], [1, 2], [2, 3]]), np.array([1, -1, 0])
    dataset = PreferenceDataset(arrays, pairs, np.array([1.0, 0.5, 0.0]), decisive_agents=agents)
    assert dataset.take([2, 0]).decisive_agents.tolist() == [0, 1]
    assert dataset.weighted([0.5, 1, 1]).decisive_agents.tolist() == [1, -1, 0]
    without = PreferenceDataset(arrays, pairs, np.array([1.0, 0.5, 0.0]))
    assert without.joined(dataset).decisive_agents.tolist() == [-1, -1, -1, 1, -1, 0]


@pytest.mark.parametrize("agent", [-2, 99])
def test_decisive_agent_must_exist(agent):
    with pytest.raises(InvalidAgent) as refused:
        PreferenceDataset(segments(), np.array([[0, 1], [1, 2]]), np.ones(2), decisive_agents=np.array([-1, agent]))
    assert (refused.value.index, refused.value.agent) == (1, agent)
