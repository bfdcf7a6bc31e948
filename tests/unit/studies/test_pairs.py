"""Pairs to learn from and pairs to test on never share a segment."""

import numpy as np
import pytest

from mapt.studies.errors import InvalidStudy
from mapt.studies.pairs import fresh_pairs, split_replay, training_pairs


def test_no_test_segment_is_learned_from():
    split = split_replay(300, seed=4)
    assert len(split.test) == 60
    assert sorted([*split.train, *split.test]) == list(range(300))
    assert set(training_pairs(300, 2000, seed=4).ravel()) <= set(split.train)
    assert set(fresh_pairs(300, 2000, seed=4).ravel()) <= set(split.test)


def test_pairs_are_of_two_segments_and_every_segment_is_drawn():
    pairs = training_pairs(50, 3000, seed=0)
    assert (pairs[:, 0] != pairs[:, 1]).all()
    for side in pairs.T:
        assert set(side) == set(split_replay(50, seed=0).train)


def test_more_pairs_begin_with_the_fewer():
    np.testing.assert_array_equal(training_pairs(100, 40, seed=1), training_pairs(100, 400, seed=1)[:40])


def test_seeds_split_and_draw_differently():
    assert not np.array_equal(split_replay(100, 0).test, split_replay(100, 1).test)
    assert not np.array_equal(training_pairs(100, 40, 0), training_pairs(100, 40, 1))


def test_a_handful_of_segments_cannot_be_split():
    with pytest.raises(InvalidStudy):
        split_replay(9, seed=0)
