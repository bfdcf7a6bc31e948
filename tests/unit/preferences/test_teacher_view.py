import numpy as np
import pytest

from mapt.errors import InvalidMask, MissingArray, NotFinite, ShapeError
from mapt.preferences.teachers import TeacherView


def segment(n_steps, seed=0, **changes):
    rng = np.random.default_rng(seed)
    shapes = {"rewards": (), "observations": (2, 4), "actions": (2, 1), "qpos": (3,), "qvel": (3,)}
    return {name: rng.normal(size=(n_steps, *shape)) for name, shape in shapes.items()} | changes


def test_segments_of_different_lengths_are_padded_at_the_end():
    segments = [segment(3), segment(1, seed=1)]
    view = TeacherView.stack(segments)
    assert view.mask.tolist() == [[True, True, True], [True, False, False]]
    assert view.lengths.tolist() == [3, 1]
    for name in ("rewards", "observations", "actions", "qpos", "qvel"):
        for row, each in zip(getattr(view, name), segments, strict=True):
            np.testing.assert_array_equal(row[: len(each[name])], each[name])


def test_arrays_that_a_segment_lacks_are_left_out():
    view = TeacherView.stack([segment(2), {"rewards": np.zeros(2)}])
    assert view.observations is None
    with pytest.raises(MissingArray) as refused:
        view.require("observations")
    assert refused.value.what == "observations"


def test_unknown_arrays_are_ignored():
    assert len(TeacherView.stack([segment(2, pixels=np.zeros(7))])) == 1


def test_segments_without_rewards_are_refused():
    with pytest.raises(MissingArray) as refused:
        TeacherView.stack([{"actions": np.zeros((2, 1, 1))}])
    assert refused.value.what == "rewards"


def test_arrays_of_different_lengths_are_refused():
    with pytest.raises(ShapeError) as refused:
        TeacherView.stack([segment(2, actions=np.zeros((3, 2, 1)))])
    assert refused.value.name == "actions"


def test_stacking_no_segments_is_refused():
    with pytest.raises(ShapeError):
        TeacherView.stack([])


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"rewards": np.zeros(3)}, ShapeError),
        ({"rewards": np.zeros((2, 0))}, ShapeError),
        ({"mask": np.ones((2, 4), bool)}, ShapeError),
        ({"observations": np.zeros((2, 3, 4))}, ShapeError),
        ({"actions": np.zeros((2, 4, 1, 1))}, ShapeError),
        ({"qpos": np.zeros((2, 2, 4))}, ShapeError),
        ({"mask": np.array([[True] * 3, [True, False, True]])}, InvalidMask),
        ({"mask": np.array([[True] * 3, [False] * 3])}, InvalidMask),
        ({"rewards": np.array([[0, 0, 0], [0, np.nan, 0]])}, NotFinite),
    ],
)
def test_invalid_arrays_are_refused(changes, error):
    with pytest.raises(error):
        TeacherView(**{"rewards": np.zeros((2, 3)), **changes})


def test_padding_may_hold_nan():
    view = TeacherView(np.array([[1.0, np.nan]]), np.array([[True, False]]))
    assert view.lengths.tolist() == [1]


def test_take_selects_segments():
    view = TeacherView.stack([segment(3, seed) for seed in range(4)])
    taken = view.take([2, 0])
    np.testing.assert_array_equal(taken.actions, view.actions[[2, 0]])
    np.testing.assert_array_equal(taken.rewards, view.rewards[[2, 0]])
    assert TeacherView(np.zeros((2, 3))).take([1]).actions is None


def test_columns_are_zero_in_the_padding():
    view = TeacherView.stack([segment(3), segment(1)])
    found = view.columns((3, 0), (1,))
    np.testing.assert_array_equal(found[0, :, 0], view.observations[0, :, 1][:, [3, 0]])
    assert not found[1, 1:].any()


@pytest.mark.parametrize(("columns", "agents"), [((4,), None), ((-1,), None), ((0,), (2,)), ((0,), (-1,))])
def test_missing_columns_and_agents_are_refused(columns, agents):
    with pytest.raises(MissingArray):
        TeacherView.stack([segment(2)]).columns(columns, agents)
