"""Pairs to learn from and pairs to test on, from segments that the two never share."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapt.studies.errors import InvalidStudy

IntArray = NDArray[np.int64]
#: what part of a replay is kept for testing, and the most segments
TEST_SHARE, MOST_TEST_SEGMENTS = 0.2, 1000


@dataclass(frozen=True, slots=True)
class Split:
    """Indices of a replay's segments, each in the order they were made."""

    train: IntArray
    test: IntArray


def split_replay(n_segments: int, seed: int) -> Split:
    """Keep some segments, drawn at random, for testing alone.

    Raises:
        InvalidStudy: with fewer than 10 segments.
    """
    if n_segments < 10:
        raise InvalidStudy(f"a replay of {n_segments} segments is too small to split; it needs 10")
    n_test = min(MOST_TEST_SEGMENTS, round(TEST_SHARE * n_segments))
    order = np.random.default_rng([seed, 0]).permutation(n_segments)
    return Split(np.sort(order[n_test:]), np.sort(order[:n_test]))


def random_pairs(pool: IntArray, n_pairs: int, rng: np.random.Generator) -> IntArray:
    """(P, 2) pairs of different segments of `pool`, uniformly; a longer draw begins with the shorter one."""
    first, second = rng.random((n_pairs, 2)).T
    first = (first * len(pool)).astype(np.int64)
    second = (second * (len(pool) - 1)).astype(np.int64)
    second += second >= first
    return np.stack([pool[first], pool[second]], axis=1)


def training_pairs(n_segments: int, n_pairs: int, seed: int) -> IntArray:
    """Pairs (P, 2) of segments to learn from."""
    return random_pairs(split_replay(n_segments, seed).train, n_pairs, np.random.default_rng([seed, 1]))


def fresh_pairs(n_segments: int, n_pairs: int, seed: int) -> IntArray:
    """Pairs (P, 2) of segments to test on."""
    return random_pairs(split_replay(n_segments, seed).test, n_pairs, np.random.default_rng([seed, 2]))
