"""Which parts of a rollout become segments."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# The share of a segment's steps that an episode must have had to be shown at all: less is nothing to judge by.
SHORTEST_SHARE = 0.2


class Stretch(NamedTuple):
    """Consecutive steps of one environment within one episode."""

    env: int
    first: int
    #: the step after the last
    end: int

    @property
    def n_steps(self) -> int:
        return self.end - self.first


def episode_stretches(episode_start: NDArray[np.bool_]) -> list[Stretch]:
    """The stretches of a rollout that are of one episode each, in the order of environments.

    Args:
        episode_start: (L, E), true where the step is an episode's first.
    """
    length, n_envs = episode_start.shape
    stretches: list[Stretch] = []
    for env in range(n_envs):
        inner = np.flatnonzero(episode_start[1:, env]) + 1
        stretches.extend(Stretch(env, first, end) for first, end in pairwise([0, *inner.tolist(), length]))
    return stretches


def cut(
    episode_start: NDArray[np.bool_],
    terminated: NDArray[np.bool_],
    segment_steps: int,
    rng: np.random.Generator,
) -> list[Stretch]:
    """Segments that do not overlap and do not cross an episode's end, in random order.

    Each stretch of an episode is laid out with as many segments as fit, the first at a random place, so that over a
    run every phase of an episode is as likely to begin one. An episode that terminates before a whole segment fits (a
    walker that falls) is a shorter one, from a fifth of the steps on: else nobody could be asked about it.

    Args:
        episode_start, terminated: (L, E), whether the step is an episode's first, and whether it ended there by itself.
    """
    places: list[Stretch] = []
    for stretch in episode_stretches(episode_start):
        env, first, end = stretch
        count, slack = divmod(stretch.n_steps, segment_steps)
        offset = first + int(rng.integers(slack + 1))
        begins = (offset + segment_steps * index for index in range(count))
        places.extend(Stretch(env, begin, begin + segment_steps) for begin in begins)
        if not count and terminated[end - 1, env] and stretch.n_steps >= SHORTEST_SHARE * segment_steps:
            places.append(stretch)
    return [places[index] for index in rng.permutation(len(places))]
