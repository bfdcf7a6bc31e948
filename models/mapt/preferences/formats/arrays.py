"""Foreign arrays, checked, as ours."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidAction, InvalidFile
from mapt.preferences.actions import one_hot_actions
from mapt.preferences.dataset import FloatArray


def as_array(path: Path | str, where: str, values: object) -> NDArray[Any]:
    """Raises InvalidFile for lists that are no array."""
    try:
        return np.asarray(values)
    except ValueError as error:
        raise InvalidFile(path, f"{where} is no array ({error})") from error


def numbers(path: Path | str, where: str, values: object, n_dims: int) -> NDArray[Any]:
    """An array of numbers with as many dimensions, none of them 0.

    Args:
        where: what it is called in an error.

    Raises:
        InvalidFile: if it is not.
    """
    array = as_array(path, where, values)
    if array.dtype.kind not in "biuf":
        raise InvalidFile(path, f"{where} holds {array.dtype}, not numbers")
    if array.ndim != n_dims or 0 in array.shape:
        raise InvalidFile(path, f"{where} has shape {array.shape}, not {n_dims} dimensions")
    return array


def finite_floats(path: Path | str, where: str, values: object, n_dims: int) -> FloatArray:
    """As `numbers`, float32 and without NaN or infinity."""
    array = numbers(path, where, values, n_dims)
    with np.errstate(over="ignore"):
        floats = array.astype(np.float32)
    if not np.isfinite(floats).all():
        raise InvalidFile(path, f"{where} holds NaN, infinity or a number beyond float32")
    return floats


def finite_doubles(path: Path | str, where: str, values: object, n_dims: int) -> NDArray[np.float64]:
    """As `finite_floats`, in float64."""
    doubles = numbers(path, where, values, n_dims).astype(np.float64)
    if not np.isfinite(doubles).all():
        raise InvalidFile(path, f"{where} holds NaN or infinity")
    return doubles


def numbered_actions(path: Path | str, where: str, values: object, n_actions: int) -> FloatArray:
    """Discrete actions (T, N) or (T, N, 1), one-hot (T, N, A).

    Raises:
        InvalidFile: if one is not in [0, `n_actions`).
    """
    array = as_array(path, where, values)
    array = numbers(path, where, array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array, 2)
    chosen = array.astype(np.int64)
    if (chosen != array).any():
        raise InvalidFile(path, f"{where} holds an action that is no whole number")
    try:
        return one_hot_actions(chosen, n_actions)
    except InvalidAction as error:
        raise InvalidFile(path, f"{where}: {error}") from error
