import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from mapt.preferences.cutting import Stretch, cut, episode_stretches


@given(
    arrays.arrays(np.bool_, st.tuples(st.integers(1, 40), st.integers(1, 4))),
    st.integers(2, 12),
    st.integers(0, 2**32),
)
def test_segments_overlap_neither_each_other_nor_two_episodes(episode_start, segment_steps, seed):
    taken = np.zeros(episode_start.shape, dtype=int)
    places = cut(episode_start, np.zeros_like(episode_start), segment_steps, np.random.default_rng(seed))
    for env, first, end in places:
        assert end - first == segment_steps
        assert taken[first:end, env].shape == (segment_steps,)
        taken[first:end, env] += 1
        assert not episode_start[first + 1 : end, env].any()
    assert taken.max(initial=0) <= 1
    assert len(places) == sum(stretch.n_steps // segment_steps for stretch in episode_stretches(episode_start))


def test_an_episode_that_terminates_too_early_for_a_segment_is_a_shorter_one():
    starts, ends = np.zeros((40, 2), dtype=bool), np.zeros((40, 2), dtype=bool)
    # Of the first environment: 12 steps, 1 step, 15 steps, and 12 that go on; of the second: 9 cut off by a time limit.
    starts[[0, 12, 13, 28], 0] = True
    ends[[11, 12, 27], 0] = True
    starts[[0, 9], 1] = True
    places = cut(starts, ends, 14, np.random.default_rng(0))
    assert set(places) - {place for place in places if place.n_steps == 14} == {Stretch(0, 0, 12)}
    assert sorted((place.env, place.n_steps) for place in places) == [(0, 12), (0, 14), (1, 14), (1, 14)]


def test_same_seed_cuts_the_same_segments():
    episode_start = never = np.zeros((100, 8), dtype=bool)
    first, second, other = (cut(episode_start, never, 20, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert first == second
    assert first != other


def test_every_phase_of_an_episode_can_begin_a_segment():
    episode_start = never = np.zeros((100, 1), dtype=bool)
    firsts = {cut(episode_start, never, 30, np.random.default_rng(seed))[0].first for seed in range(300)}
    assert {0, 10, 70} <= firsts
