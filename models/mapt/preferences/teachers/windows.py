"""Windows that slide over the real steps of segments."""

import numpy as np

from mapt.errors import InvalidTeacher
from mapt.preferences.teachers.evidence import BoolArray, Float64s


def check_window(window_steps: int) -> None:
    """Raises InvalidTeacher unless a window can have so many steps."""
    if window_steps < 1:
        raise InvalidTeacher(f"a window has 1 step or more, not {window_steps}")


def window_means(values: Float64s, mask: BoolArray, window_steps: int) -> tuple[Float64s, BoolArray]:
    """Means over every run of `window_steps` successive real steps; a shorter segment is one window.

    Args:
        values: (B, T) or (B, T, N).
        mask: (B, T), real steps first.

    Returns:
        means, shaped like `values`: at step t that of the window that starts there; and bool (B, T), true where one
        does.
    """
    n_steps = values.shape[1]
    extra = (1,) * (values.ndim - 2)
    real = np.where(mask.reshape(*mask.shape, *extra), values, 0.0)
    before = np.concatenate((np.zeros_like(real[:, :1]), real.cumsum(axis=1)), axis=1)
    lengths = mask.sum(axis=1)
    widths = np.minimum(window_steps, lengths)
    starts = np.arange(n_steps)
    ends = np.minimum(starts + widths[:, None], n_steps)
    sums = np.take_along_axis(before, ends.reshape(*ends.shape, *extra), axis=1) - before[:, :-1]
    return sums / widths.reshape(-1, 1, *extra), starts <= (lengths - widths)[:, None]


def last_means(values: Float64s, mask: BoolArray, window_steps: int) -> Float64s:
    """Mean of values (B, T) over the last `window_steps` real steps, or all where there are fewer: (B,)."""
    means, starts = window_means(values, mask, window_steps)
    return means[np.arange(len(means)), starts.sum(axis=1) - 1]


def real_means(values: Float64s, mask: BoolArray) -> Float64s:
    """Mean of values (B, T, ...) over real steps, (B, ...)."""
    extra = (1,) * (values.ndim - 2)
    sums = np.where(mask.reshape(*mask.shape, *extra), values, 0.0).sum(axis=1)
    return sums / mask.sum(axis=1).reshape(-1, *extra)
