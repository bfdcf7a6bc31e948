"""Scripted teachers: they know the true reward and label as a person would have to."""

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.preferences.errors import ShapeError


class Teacher(Protocol):
    """Judges pairs of segments by their true per-step rewards."""

    def judge(
        self,
        rewards_0: ArrayLike,
        rewards_1: ArrayLike,
        mask_0: ArrayLike | None = None,
        mask_1: ArrayLike | None = None,
    ) -> NDArray[np.float32]:
        """Label B pairs.

        Args:
            rewards_0, rewards_1: true reward of each step, (B, T).
            mask_0, mask_1: bool (B, T), true where the step is real; all of them when not given.

        Returns:
            float32 (B,): P(segment 0 preferred); NaN where the teacher skips the pair.
        """
        ...


class OracleTeacher:
    """Prefers the segment with the larger true return, without error; equal returns give 0.5."""

    def judge(
        self,
        rewards_0: ArrayLike,
        rewards_1: ArrayLike,
        mask_0: ArrayLike | None = None,
        mask_1: ArrayLike | None = None,
    ) -> NDArray[np.float32]:
        """See `Teacher.judge`; never skips.

        Raises:
            ShapeError: if the two sides, or a mask and its rewards, differ in shape.
        """
        returns_0 = segment_returns(rewards_0, mask_0)
        returns_1 = segment_returns(rewards_1, mask_1)
        if returns_0.shape != returns_1.shape:
            raise ShapeError("rewards_1", returns_1.shape, f"as many segments as rewards_0, {returns_0.shape}")
        return (0.5 + 0.5 * np.sign(returns_0 - returns_1)).astype(np.float32)


def segment_returns(rewards: ArrayLike, mask: ArrayLike | None = None) -> NDArray[np.float64]:
    """Sum of the rewards (B, T) of each segment over its real steps, float64 (B,).

    Raises:
        ShapeError: if `rewards` is not (B, T) or the mask's shape differs.
    """
    per_step = np.asarray(rewards, dtype=np.float64)
    if per_step.ndim != 2:
        raise ShapeError("rewards", per_step.shape, "(B, T)")
    if mask is None:
        return per_step.sum(axis=1)
    real = np.asarray(mask, dtype=np.bool_)
    if real.shape != per_step.shape:
        raise ShapeError("mask", real.shape, f"{per_step.shape}")
    return np.where(real, per_step, 0.0).sum(axis=1)
