import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from mapt.errors import InvalidAction, ShapeError
from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.segments import StepRange, cut_rollout, episode_ranges, one_hot_actions


@given(
    arrays.arrays(np.bool_, st.tuples(st.integers(1, 40), st.integers(1, 4))),
    st.integers(2, 12),
    st.integers(0, 2**32),
)
def test_segments_neither_overlap_nor_cross_episodes(episode_start, segment_steps, seed):
    n_covering = np.zeros(episode_start.shape, dtype=int)
    places = cut_rollout(episode_start, np.zeros_like(episode_start), segment_steps, np.random.default_rng(seed))
    for env, first, end in places:
        assert end - first == segment_steps
        assert n_covering[first:end, env].shape == (segment_steps,)
        n_covering[first:end, env] += 1
        assert not episode_start[first + 1 : end, env].any()
    assert n_covering.max(initial=0) <= 1
    assert len(places) == sum(episode.n_steps // segment_steps for episode in episode_ranges(episode_start))


def test_the_end_of_an_episode_that_terminates_becomes_a_shorter_segment():
    starts, ends = np.zeros((60, 2), dtype=bool), np.zeros((60, 2), dtype=bool)
    # Environment 0: terminated episodes of 12, 1 and 20 steps, and 27 steps of one that continues.
    # Environment 1: 24 steps truncated by a time limit, and 36 that continue.
    starts[[0, 12, 13, 33], 0] = True
    ends[[11, 12, 32], 0] = True
    starts[[0, 24], 1] = True
    shorter: set[StepRange] = set()
    for seed in range(50):
        places = cut_rollout(starts, ends, 14, np.random.default_rng(seed))
        full = sorted(place for place in places if place.n_steps == 14)
        assert [place.env for place in full] == [0, 0, 1, 1, 1]
        shorter |= set(places) - set(full)
    # The full segment of the episode of 20 steps leaves up to 6 at its end; less than a fifth of 14 are too few.
    assert shorter == {StepRange(0, 0, 12), *(StepRange(0, first, 33) for first in range(27, 31))}


def test_same_seed_cuts_the_same_segments():
    episode_start = never = np.zeros((100, 8), dtype=bool)
    first, second, other = (cut_rollout(episode_start, never, 20, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert first == second
    assert first != other


def test_segments_can_start_at_any_phase_of_an_episode():
    episode_start = never = np.zeros((100, 1), dtype=bool)
    firsts = {cut_rollout(episode_start, never, 30, np.random.default_rng(seed))[0].first for seed in range(300)}
    assert {0, 10, 70} <= firsts


S, T, N, A = 2, 4, 3, 5


def indices() -> np.ndarray:
    return np.random.default_rng(0).integers(0, A, (S, T, N))


@given(arrays.arrays(np.int64, arrays.array_shapes(min_dims=1, max_dims=4, max_side=4), elements=st.integers(0, A - 1)))
def test_indices_survive_the_conversion_to_one_hot(chosen):
    one_hot = one_hot_actions(chosen, A)
    assert one_hot.dtype == np.float32
    assert one_hot.shape == (*chosen.shape, A)
    assert (one_hot.sum(axis=-1) == 1).all()
    assert (one_hot.argmax(axis=-1) == chosen).all()
    assert (one_hot_actions(one_hot, A) == one_hot).all()
    assert (one_hot_actions(one_hot.astype(bool), A) == one_hot).all()


def test_segments_accept_one_hot_actions():
    actions = one_hot_actions(indices(), A)
    segments = SegmentArrays.stack(list(np.zeros((S, T, N, 6))), list(actions))
    assert segments.action_dim == A


def test_available_actions_are_accepted():
    available = np.zeros((S, T, N, A), dtype=bool)
    np.put_along_axis(available, indices()[..., None], True, axis=-1)
    assert (one_hot_actions(indices(), A, available) == available).all()


# The message is the only place where the position of an invalid action is reported.
def test_message_gives_the_position_of_an_unavailable_action():
    available = np.ones((S, T, N, A), dtype=bool)
    available[1, 2, 0, indices()[1, 2, 0]] = False
    message = f"Action {indices()[1, 2, 0]} of agent 0 of step 2 of segment 1 is not available"
    for actions in (indices(), one_hot_actions(indices(), A)):
        with pytest.raises(InvalidAction) as refused:
            one_hot_actions(actions, A, available)
        assert message in str(refused.value)


@pytest.mark.parametrize("wrong", [-1, A, A + 100])
def test_message_gives_the_position_of_a_nonexistent_action(wrong):
    actions = indices()
    actions[0, 3, 1] = wrong
    with pytest.raises(InvalidAction) as refused:
        one_hot_actions(actions, A)
    assert f"Action {wrong} of agent 1 of step 3 of segment 0 is not one of 0 to 4" in str(refused.value)


@pytest.mark.parametrize("row", [[0, 0, 0, 0, 0], [1, 0, 1, 0, 0], [0.5, 0.5, 0, 0, 0], [2, 0, 0, -1, 0], [np.nan] * 5])
def test_actions_that_are_not_one_hot_are_refused(row):
    actions = one_hot_actions(indices(), A)
    actions[1, 0, 2] = row
    with pytest.raises(InvalidAction) as refused:
        one_hot_actions(actions, A)
    assert "agent 2 of step 0 of segment 1 is not one-hot" in str(refused.value)


@pytest.mark.parametrize(
    ("actions", "available", "name"),
    [
        (np.zeros((S, T, N, A + 1)), None, "actions"),
        (3, None, "actions"),
        (np.array([["up"]]), None, "actions"),
        (indices(), np.ones((S, T, A), dtype=bool), "available actions"),
    ],
)
def test_arrays_with_the_wrong_shape_are_refused(actions, available, name):
    with pytest.raises(ShapeError) as refused:
        one_hot_actions(actions, A, available)
    assert refused.value.name == name
