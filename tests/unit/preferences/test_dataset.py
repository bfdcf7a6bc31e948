import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import InvalidLabel, InvalidMask, InvalidPair, NotEnoughPairs, NotFinite, ShapeError
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


@given(st.integers(2, 300), st.sampled_from([0.1, 0.2, 0.25, 0.5]), st.integers(0, 5))
def test_split_holds_out_its_fraction_and_keeps_every_pair(n_pairs, fraction, seed):
    train, hold_out = dataset(n_pairs).split(fraction, seed)
    assert len(train) + len(hold_out) == n_pairs
    assert abs(len(hold_out) - fraction * n_pairs) <= 1


@given(st.integers(2, 200), st.integers(0, 100), st.sampled_from([0.1, 0.2, 0.3]), st.integers(0, 5))
def test_pairs_stay_on_their_side_as_labels_are_appended(n_pairs, n_more, fraction, seed):
    def sides(n):
        # The label encodes the index of the pair.
        numbered = PreferenceDataset(segments(), np.tile([[0, 1]], (n, 1)), np.arange(n, dtype=np.float32) / 1000)
        _, hold_out = numbered.split(fraction, seed)
        return set(np.rint(hold_out.labels * 1000).astype(int).tolist())

    assert {i for i in sides(n_pairs + n_more) if i < n_pairs} == sides(n_pairs)


def test_split_depends_on_the_seed():
    first, second = (dataset(100).split(0.2, seed)[1].pairs for seed in (0, 1))
    assert not np.array_equal(first, second)


def test_one_pair_cannot_be_split():
    with pytest.raises(NotEnoughPairs):
        dataset(1).split(0.2, 0)
