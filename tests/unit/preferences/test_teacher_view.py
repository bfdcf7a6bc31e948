import numpy as np
import pytest

from mapt.errors import InvalidMask, MissingView, NotFinite, ShapeError
from mapt.preferences.teachers import TeacherView


def segment(n_steps, seed=0, **changes):
    rng = np.random.default_rng(seed)
    shapes = {"rewards": (), "observations": (2, 4), "actions": (2, 1), "qpos": (3,), "qvel": (3,)}
    return {name: rng.normal(size=(n_steps, *shape)) for name, shape in shapes.items()} | changes


def test_segments_of_different_lengths_are_padded_after_their_steps():
    segments = [segment(3), segment(1, seed=1)]
    evidence = TeacherView.stack(segments)
    assert evidence.mask.tolist() == [[True, True, True], [True, False, False]]
    assert evidence.lengths.tolist() == [3, 1]
    for name in ("rewards", "observations", "actions", "qpos", "qvel"):
        for row, each in zip(getattr(evidence, name), segments, strict=True):
            np.testing.assert_array_equal(row[: len(each[name])], each[name])


def test_what_one_segment_lacks_none_has():
    evidence = TeacherView.stack([segment(2), {"rewards": np.zeros(2)}])
    assert evidence.observations is None
    with pytest.raises(MissingView, match="observations"):
        evidence.seen("observations")


def test_arrays_besides_are_no_evidence():
    assert len(TeacherView.stack([segment(2, pixels=np.zeros(7))])) == 1


def test_segments_without_rewards_are_refused():
    with pytest.raises(MissingView, match="rewards"):
        TeacherView.stack([{"actions": np.zeros((2, 1, 1))}])


def test_no_segments_are_refused():
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
def test_arrays_that_disagree_are_refused(changes, error):
    with pytest.raises(error):
        TeacherView(**{"rewards": np.zeros((2, 3)), **changes})


def test_padding_may_hold_anything():
    evidence = TeacherView(np.array([[1.0, np.nan]]), np.array([[True, False]]))
    assert evidence.lengths.tolist() == [1]


def test_taking_keeps_what_there_is():
    evidence = TeacherView.stack([segment(3, seed) for seed in range(4)])
    taken = evidence.take([2, 0])
    np.testing.assert_array_equal(taken.actions, evidence.actions[[2, 0]])
    np.testing.assert_array_equal(taken.rewards, evidence.rewards[[2, 0]])
    assert TeacherView(np.zeros((2, 3))).take([1]).actions is None


def test_columns_are_zero_in_padding():
    evidence = TeacherView.stack([segment(3), segment(1)])
    found = evidence.columns((3, 0), (1,))
    np.testing.assert_array_equal(found[0, :, 0], evidence.observations[0, :, 1][:, [3, 0]])
    assert not found[1, 1:].any()


@pytest.mark.parametrize(("columns", "agents"), [((4,), None), ((-1,), None), ((0,), (2,)), ((0,), (-1,))])
def test_columns_and_agents_that_are_not_there_are_named(columns, agents):
    with pytest.raises(MissingView, match=r"of [24] in observations"):
        TeacherView.stack([segment(2)]).columns(columns, agents)
