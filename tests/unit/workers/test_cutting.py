import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from accord.workers.cutting import cut, episode_spans


@given(
    arrays.arrays(np.bool_, st.tuples(st.integers(1, 40), st.integers(1, 4))),
    st.integers(2, 12),
    st.integers(0, 2**32),
)
def test_segments_overlap_neither_each_other_nor_two_episodes(episode_start, segment_steps, seed):
    taken = np.zeros(episode_start.shape, dtype=int)
    places = cut(episode_start, segment_steps, np.random.default_rng(seed))
    for first, env in places:
        steps = slice(first, first + segment_steps)
        assert taken[steps, env].shape == (segment_steps,)
        taken[steps, env] += 1
        assert not episode_start[first + 1 : first + segment_steps, env].any()
    assert taken.max(initial=0) <= 1
    expected = sum((last - first) // segment_steps for _, first, last in episode_spans(episode_start))
    assert len(places) == expected


def test_same_seed_cuts_the_same_segments():
    episode_start = np.zeros((100, 8), dtype=bool)
    first, second = (cut(episode_start, 20, np.random.default_rng(5)) for _ in range(2))
    assert first == second
    assert first != cut(episode_start, 20, np.random.default_rng(6))


def test_every_phase_of_an_episode_can_begin_a_segment():
    episode_start = np.zeros((100, 1), dtype=bool)
    firsts = {cut(episode_start, 30, np.random.default_rng(seed))[0][0] for seed in range(300)}
    assert {0, 10, 70} <= firsts
