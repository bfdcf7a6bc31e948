"""Generalised advantage estimation (Schulman et al. 2016) where episodes end inside a rollout."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Bools = NDArray[np.bool_]


def advantages(
    rewards: Floats,
    values: Floats,
    next_values: Floats,
    terminated: Bools,
    truncated: Bools,
    *,
    gamma: float,
    gae_lambda: float,
) -> Floats:
    """Advantages (L, E, N) of the actions of a rollout.

    A truncated episode is cut for bookkeeping only, so the value of its last state still counts. After termination
    there is nothing to come. Neither lets the next episode's rewards flow back.

    Args:
        rewards: (L, E, N).
        values: (L, E, N), of the states in which the actions were taken.
        next_values: (L, E, N), of the states they led to, before any reset.
        terminated, truncated: (L, E).
        gamma, gae_lambda: discount per step and the estimator's lambda.
    """
    going_on = (~terminated)[..., None]
    surprise = rewards + gamma * next_values * going_on - values
    carry = gamma * gae_lambda * (~(terminated | truncated))[..., None].astype(values.dtype)
    result = np.empty_like(values)
    later = np.zeros_like(values[0])
    for t in range(len(values) - 1, -1, -1):
        later = surprise[t] + carry[t] * later
        result[t] = later
    return result
