"""Which parts of a rollout become segments."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray


def episode_spans(episode_start: NDArray[np.bool_]) -> list[tuple[int, int, int]]:
    """The stretches of a rollout that are of one episode each.

    Args:
        episode_start: (L, E), true where the step is an episode's first.

    Returns:
        (environment, first step, step after the last), in the order of environments.
    """
    length, n_envs = episode_start.shape
    spans: list[tuple[int, int, int]] = []
    for env in range(n_envs):
        inner = np.flatnonzero(episode_start[1:, env]) + 1
        bounds = [0, *inner.tolist(), length]
        spans.extend((env, first, last) for first, last in pairwise(bounds))
    return spans


def cut(episode_start: NDArray[np.bool_], segment_steps: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Segments that do not overlap and do not cross an episode's end, in random order.

    Each stretch is laid out with as many segments as fit, the first at a random place, so that over a run every
    phase of an episode is as likely to begin one.

    Returns:
        (first step, environment) of each.
    """
    places: list[tuple[int, int]] = []
    for env, first, last in episode_spans(episode_start):
        count = (last - first) // segment_steps
        slack = last - first - count * segment_steps
        offset = first + int(rng.integers(slack + 1))
        places.extend((offset + segment_steps * index, env) for index in range(count))
    return [places[index] for index in rng.permutation(len(places))]
