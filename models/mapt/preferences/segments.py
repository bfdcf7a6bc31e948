"""Which parts of a rollout become segments."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import InvalidAction, NotOneHot, ShapeError
from mapt.preferences.dataset import SegmentArrays

# The share of a segment's steps that an episode must have had to be shown at all: less is nothing to judge by.
MIN_EPISODE_FRACTION = 0.2


class StepRange(NamedTuple):
    """Consecutive steps of one environment within one episode."""

    env: int
    first: int
    #: the step after the last
    end: int

    @property
    def n_steps(self) -> int:
        return self.end - self.first


def episode_ranges(episode_start: NDArray[np.bool_]) -> list[StepRange]:
    """The stretches of a rollout that are of one episode each, in the order of environments.

    Args:
        episode_start: (L, E), true where the step is an episode's first.
    """
    length, n_envs = episode_start.shape
    stretches: list[StepRange] = []
    for env in range(n_envs):
        inner = np.flatnonzero(episode_start[1:, env]) + 1
        stretches.extend(StepRange(env, first, end) for first, end in pairwise([0, *inner.tolist(), length]))
    return stretches


def cut_rollout(
    episode_start: NDArray[np.bool_],
    terminated: NDArray[np.bool_],
    segment_steps: int,
    rng: np.random.Generator,
) -> list[StepRange]:
    """Segments that do not overlap and do not cross an episode's end, in random order.

    Each stretch of an episode is laid out with as many segments as fit, the first at a random place, so that over a
    run every phase of an episode is as likely to begin one. An episode that terminates before a whole segment fits (a
    walker that falls) is a shorter one, from a fifth of the steps on: else nobody could be asked about it.

    Args:
        episode_start, terminated: (L, E), whether the step is an episode's first, and whether it ended there by itself.
    """
    places: list[StepRange] = []
    for stretch in episode_ranges(episode_start):
        env, first, end = stretch
        count, slack = divmod(stretch.n_steps, segment_steps)
        offset = first + int(rng.integers(slack + 1))
        begins = (offset + segment_steps * index for index in range(count))
        places.extend(StepRange(env, begin, begin + segment_steps) for begin in begins)
        if not count and terminated[end - 1, env] and stretch.n_steps >= MIN_EPISODE_FRACTION * segment_steps:
            places.append(stretch)
    return [places[index] for index in rng.permutation(len(places))]


# How a message calls the places of an action in its array, from the last one back.
_PLACES = ("agent", "step", "segment")


def one_hot_actions(actions: ArrayLike, n_actions: int, available: ArrayLike | None = None) -> NDArray[np.float32]:
    """Discrete actions as float32 (..., N, A), for `SegmentArrays` and for relabelling.

    Padding is as real as any step here: pad afterwards (`SegmentArrays.stack` does), or with an available action.

    Args:
        actions: whole numbers (..., N) in [0, A), or one-hot already, (..., N, A).
        n_actions: A.
        available: bool (..., N, A), which actions each agent could choose; all when not given.

    Raises:
        ShapeError: if `actions` is neither of the two, or `available` has not the shape of the one-hot actions.
        InvalidAction: naming the first action that does not exist, is not one-hot, or was not available.
    """
    given = np.asarray(actions)
    one_hot = _from_numbers(given, n_actions) if given.dtype.kind in "iu" else _checked(given, n_actions)
    if available is not None:
        could = np.asarray(available)
        if could.shape != one_hot.shape:
            raise ShapeError("available actions", could.shape, f"that of the one-hot actions, {one_hot.shape}")
        refused = np.asarray((one_hot.astype(np.bool_) & ~could.astype(np.bool_)).any(axis=-1))
        _refuse(refused, one_hot.argmax(axis=-1), "available")
    return one_hot


def action_numbers(segments: SegmentArrays) -> NDArray[np.int64]:
    """Which of its A choices each one-hot action is, int64 (S, T, N); in the padding anything.

    Raises:
        NotOneHot: naming the first segment with an action that is none.
    """
    broken = (~_is_one_hot(segments.actions).all(axis=-1) & segments.mask).any(axis=-1)
    if broken.any():
        raise NotOneHot(int(broken.argmax()))
    return segments.actions.argmax(axis=-1)


def _is_one_hot(actions: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether an action (..., A) is a single 1 among zeros, (...)."""
    return ((actions == 0) | (actions == 1)).all(axis=-1) & (actions.sum(axis=-1) == 1)


def _from_numbers(numbers: NDArray[np.generic], n_actions: int) -> NDArray[np.float32]:
    if not numbers.ndim or n_actions < 1:
        raise ShapeError("actions", numbers.shape, f"(..., N), whole numbers below {n_actions}")
    chosen = numbers.astype(np.int64)
    _refuse((chosen < 0) | (chosen >= n_actions), chosen, f"one of 0 to {n_actions - 1}")
    return np.eye(n_actions, dtype=np.float32)[chosen]


def _checked(given: NDArray[np.generic], n_actions: int) -> NDArray[np.float32]:
    if given.ndim < 2 or given.shape[-1] != n_actions or given.dtype.kind not in "bf":
        raise ShapeError("actions", given.shape, f"(..., N) of whole numbers or one-hot (..., N, {n_actions})")
    one_hot = given.astype(np.float32)
    broken = ~_is_one_hot(one_hot)
    if broken.any():
        raise InvalidAction(f"the action of {_place(broken)} is not one-hot")
    return one_hot


def _refuse(broken: NDArray[np.bool_], chosen: NDArray[np.int64], wanted: str) -> None:
    if broken.any():
        raise InvalidAction(f"action {chosen[broken][0]} of {_place(broken)} is not {wanted}")


def _place(broken: NDArray[np.bool_]) -> str:
    """Where the first of these is, such as "agent 2 of step 3 of segment 0"."""
    first = np.argwhere(broken)[0][::-1]
    names = (f"{name} {index}" for name, index in zip(_PLACES, first, strict=False))
    return " of ".join(names)
