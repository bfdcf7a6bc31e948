"""Foreign arrays, checked, as ours."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mapt.errors import FileTooLarge, InvalidAction, InvalidFile, MissingPart
from mapt.preferences.dataset import FloatArray
from mapt.preferences.segments import one_hot_actions


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


#: What the arrays of one file may declare together.
MAX_BYTES = 16 << 30


class Hdf5File:
    """An open file; its errors name it."""

    def __init__(self, path: Path, file: h5py.File, max_bytes: int) -> None:
        self.path, self._file = path, file
        self._left, self._limit = max_bytes, max_bytes

    def names(self, group: str = "/") -> list[str]:
        """What lies in a group; nothing if it is none."""
        found = self._find(group)
        return sorted(found) if isinstance(found, h5py.Group) else []

    def is_array(self, name: str) -> bool:
        return isinstance(self._find(name), h5py.Dataset)

    def attribute(self, name: str) -> object:
        """Of the file; None if there is none."""
        return self._file.attrs.get(name)

    def array(self, name: str, n_dims: int) -> h5py.Dataset:
        """An array of numbers, not yet read.

        Raises:
            MissingPart: if it is not there.
            InvalidFile: if it holds no numbers, has other dimensions, or lies in another file.
            FileTooLarge: if it, and those asked for before, declare more than is wanted.
        """
        found = self._find(name)
        if not isinstance(found, h5py.Dataset):
            raise MissingPart(self.path, f"array {name!r}")
        if found.is_virtual or found.external:
            raise InvalidFile(self.path, f"{name} lies in another file")
        if found.dtype.kind not in "biuf":
            raise InvalidFile(self.path, f"{name} holds {found.dtype}, not numbers")
        if found.ndim != n_dims:
            raise InvalidFile(self.path, f"{name} has shape {found.shape}, not {n_dims} dimensions")
        # As what it becomes: a few bytes on disk can stand for any number of zeros.
        declared = int(np.prod(found.shape, dtype=object)) * max(8, found.dtype.itemsize)
        self._left -= declared
        if self._left < 0:
            raise FileTooLarge(self.path, f"{name} of shape {found.shape}", self._limit)
        return found

    def _find(self, name: str) -> object:
        """The object of a name, reached without leaving the file; None if there is none."""
        found: object = self._file
        for part in name.strip("/").split("/") if name != "/" else ():
            if not isinstance(found, h5py.Group) or part not in found:
                return None
            if not isinstance(found.get(part, getlink=True), h5py.HardLink):
                raise InvalidFile(self.path, f"{name} is a link to another place")
            found = found[part]
        return found


@contextmanager
def open_hdf5(path: Path, max_bytes: int = MAX_BYTES) -> Generator[Hdf5File]:
    """
    Raises:
        InvalidFile: if it is no HDF5 file, or one that is cut or damaged, also when that shows in the block.
    """
    try:
        with h5py.File(path, "r") as file:
            yield Hdf5File(path, file, max_bytes)
    except FileNotFoundError as error:
        raise InvalidFile(path, "is not there") from error
    except (OSError, RuntimeError, KeyError, MemoryError) as error:
        raise InvalidFile(path, f"is no whole HDF5 file ({error})") from error


def rows(data: h5py.Dataset, first: int, last: int) -> NDArray[np.generic]:
    """Rows [first, last) of an array."""
    return np.asarray(data[first:last])
