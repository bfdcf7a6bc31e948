import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from mapt.errors import InvalidAction, ShapeError
from mapt.preferences.actions import one_hot_actions
from mapt.preferences.dataset import SegmentArrays

S, T, N, A = 2, 4, 3, 5


def numbers() -> np.ndarray:
    return np.random.default_rng(0).integers(0, A, (S, T, N))


@given(arrays.arrays(np.int64, arrays.array_shapes(min_dims=1, max_dims=4, max_side=4), elements=st.integers(0, A - 1)))
def test_numbers_come_back_from_their_one_hot_form(chosen):
    one_hot = one_hot_actions(chosen, A)
    assert one_hot.dtype == np.float32
    assert one_hot.shape == (*chosen.shape, A)
    assert (one_hot.sum(axis=-1) == 1).all()
    assert (one_hot.argmax(axis=-1) == chosen).all()
    assert (one_hot_actions(one_hot, A) == one_hot).all()
    assert (one_hot_actions(one_hot.astype(bool), A) == one_hot).all()


def test_segments_take_one_hot_actions():
    actions = one_hot_actions(numbers(), A)
    segments = SegmentArrays.stack(list(np.zeros((S, T, N, 6))), list(actions))
    assert segments.action_dim == A


def test_an_available_action_is_taken():
    available = np.zeros((S, T, N, A), dtype=bool)
    np.put_along_axis(available, numbers()[..., None], True, axis=-1)
    assert (one_hot_actions(numbers(), A, available) == available).all()


def test_an_action_that_was_not_available_is_named_with_its_place():
    available = np.ones((S, T, N, A), dtype=bool)
    available[1, 2, 0, numbers()[1, 2, 0]] = False
    said = rf"action {numbers()[1, 2, 0]} of agent 0 of step 2 of segment 1 is not available"
    for actions in (numbers(), one_hot_actions(numbers(), A)):
        with pytest.raises(InvalidAction, match=said):
            one_hot_actions(actions, A, available)


@pytest.mark.parametrize("wrong", [-1, A, A + 100])
def test_an_action_that_does_not_exist_is_named(wrong):
    actions = numbers()
    actions[0, 3, 1] = wrong
    with pytest.raises(InvalidAction, match=f"action {wrong} of agent 1 of step 3 of segment 0 is not one of 0 to 4"):
        one_hot_actions(actions, A)


@pytest.mark.parametrize("row", [[0, 0, 0, 0, 0], [1, 0, 1, 0, 0], [0.5, 0.5, 0, 0, 0], [2, 0, 0, -1, 0], [np.nan] * 5])
def test_what_is_not_one_hot_is_refused(row):
    actions = one_hot_actions(numbers(), A)
    actions[1, 0, 2] = row
    with pytest.raises(InvalidAction, match="agent 2 of step 0 of segment 1 is not one-hot"):
        one_hot_actions(actions, A)


def test_arrays_of_another_shape_are_refused():
    with pytest.raises(ShapeError, match="actions"):
        one_hot_actions(np.zeros((S, T, N, A + 1)), A)
    with pytest.raises(ShapeError, match="actions"):
        one_hot_actions(3, A)
    with pytest.raises(ShapeError, match="available"):
        one_hot_actions(numbers(), A, np.ones((S, T, A), dtype=bool))
    with pytest.raises(ShapeError, match="actions"):
        one_hot_actions(np.array([["up"]]), A)
