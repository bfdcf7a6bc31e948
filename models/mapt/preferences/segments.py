"""Cut rollouts into segments, and convert discrete actions to one-hot and back."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import InvalidAction, NotOneHot, ShapeError
from mapt.preferences.dataset import SegmentArrays

# The end of an episode that terminates becomes a shorter segment only if it has at least this fraction of the steps:
# shorter clips show too little to compare.
MIN_END_FRACTION = 0.2


class StepRange(NamedTuple):
    """Consecutive steps of one environment within one episode."""

    env: int
    first: int
    #: one past the last step
    end: int

    @property
    def n_steps(self) -> int:
        return self.end - self.first


def episode_ranges(episode_start: NDArray[np.bool_]) -> list[StepRange]:
    """Split a rollout at episode boundaries, environment by environment.

    Args:
        episode_start: bool (L, E), true at the first step of each episode.
    """
    length, n_envs = episode_start.shape
    ranges: list[StepRange] = []
    for env in range(n_envs):
        starts = np.flatnonzero(episode_start[1:, env]) + 1
        ranges.extend(StepRange(env, first, end) for first, end in pairwise([0, *starts.tolist(), length]))
    return ranges


def cut_rollout(
    episode_start: NDArray[np.bool_],
    terminated: NDArray[np.bool_],
    segment_steps: int,
    rng: np.random.Generator,
) -> list[StepRange]:
    """Cut a rollout into segments that neither overlap nor cross the end of an episode, in random order.

    Each episode gets as many segments as fit. The first starts at a random offset, so that over many rollouts every
    phase of an episode is equally likely to start a segment. What is left of an episode that terminates (a walker that
    falls) becomes a shorter segment, if it has at least `MIN_END_FRACTION` of the steps: only beside shorter segments
    do labels say what a further step is worth.

    Args:
        episode_start, terminated: bool (L, E), true at the first step of an episode, and where an episode terminated.
        segment_steps: T.
    """
    segments: list[StepRange] = []
    for episode in episode_ranges(episode_start):
        env, first, end = episode
        count, left = divmod(episode.n_steps, segment_steps)
        first += int(rng.integers(left + 1)) if count else 0
        rest = first + segment_steps * count
        segments.extend(StepRange(env, start, start + segment_steps) for start in range(first, rest, segment_steps))
        if terminated[end - 1, env] and end - rest >= MIN_END_FRACTION * segment_steps:
            segments.append(StepRange(env, rest, end))
    return [segments[index] for index in rng.permutation(len(segments))]


# Names of the axes of an array of actions in error messages, from the last axis backwards.
_AXES = ("agent", "step", "segment")


def one_hot_actions(actions: ArrayLike, n_actions: int, available: ArrayLike | None = None) -> NDArray[np.float32]:
    """Convert discrete actions to one-hot, the input of `SegmentArrays` and reward models.

    Every step is checked, including padding: pad afterwards, as `SegmentArrays.stack` does, or with an available
    action.

    Args:
        actions: indices, int (..., N) in [0, A), or actions that are already one-hot, (..., N, A).
        n_actions: A.
        available: bool (..., N, A), the actions that each agent could choose; all if None.

    Returns:
        float32 (..., N, A).

    Raises:
        ShapeError: if `actions` or `available` has the wrong shape.
        InvalidAction: for the first action that does not exist, is not one-hot, or was not available.
    """
    given = np.asarray(actions)
    one_hot = _from_indices(given, n_actions) if given.dtype.kind in "iu" else _check_one_hot(given, n_actions)
    if available is not None:
        allowed = np.asarray(available)
        if allowed.shape != one_hot.shape:
            raise ShapeError("available actions", allowed.shape, f"that of the one-hot actions, {one_hot.shape}")
        unavailable = np.asarray((one_hot.astype(np.bool_) & ~allowed.astype(np.bool_)).any(axis=-1))
        _check_none(unavailable, one_hot.argmax(axis=-1), "available")
    return one_hot


def action_indices(segments: SegmentArrays) -> NDArray[np.int64]:
    """The index of each one-hot action, int64 (S, T, N); arbitrary in the padding.

    Raises:
        NotOneHot: for the first segment with an action that is not one-hot.
    """
    invalid = (~_is_one_hot(segments.actions).all(axis=-1) & segments.mask).any(axis=-1)
    if invalid.any():
        raise NotOneHot(int(invalid.argmax()))
    return segments.actions.argmax(axis=-1)


def _is_one_hot(actions: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether an action (..., A) is a single 1 among zeros, (...)."""
    return ((actions == 0) | (actions == 1)).all(axis=-1) & (actions.sum(axis=-1) == 1)


def _from_indices(indices: NDArray[np.generic], n_actions: int) -> NDArray[np.float32]:
    if not indices.ndim or n_actions < 1:
        raise ShapeError("actions", indices.shape, f"(..., N), indices below {n_actions}")
    chosen = indices.astype(np.int64)
    _check_none((chosen < 0) | (chosen >= n_actions), chosen, f"one of 0 to {n_actions - 1}")
    return np.eye(n_actions, dtype=np.float32)[chosen]


def _check_one_hot(given: NDArray[np.generic], n_actions: int) -> NDArray[np.float32]:
    if given.ndim < 2 or given.shape[-1] != n_actions or given.dtype.kind not in "bf":
        raise ShapeError("actions", given.shape, f"indices (..., N) or one-hot (..., N, {n_actions})")
    one_hot = given.astype(np.float32)
    invalid = ~_is_one_hot(one_hot)
    if invalid.any():
        raise InvalidAction(f"The action of {_position(invalid)} is not one-hot.")
    return one_hot


def _check_none(invalid: NDArray[np.bool_], chosen: NDArray[np.int64], wanted: str) -> None:
    if invalid.any():
        raise InvalidAction(f"Action {chosen[invalid][0]} of {_position(invalid)} is not {wanted}.")


def _position(invalid: NDArray[np.bool_]) -> str:
    """The position of the first true element, such as "agent 2 of step 3 of segment 0"."""
    first = np.argwhere(invalid)[0][::-1]
    return " of ".join(f"{name} {index}" for name, index in zip(_AXES, first, strict=False))
