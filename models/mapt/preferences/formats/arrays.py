"""Checks of arrays from untrusted files, and HDF5 files with a limit on what they declare."""

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
    """Convert to an array. Raises InvalidFile for ragged lists."""
    try:
        return np.asarray(values)
    except ValueError as error:
        raise InvalidFile(path, f"has ragged lists in {where} ({error})") from error


def numbers(path: Path | str, where: str, values: object, n_dims: int) -> NDArray[Any]:
    """Check that `values` is a non-empty array of numbers with `n_dims` dimensions, and return it.

    Args:
        where: name of the array in error messages.

    Raises:
        InvalidFile: if it is not.
    """
    array = as_array(path, where, values)
    if array.dtype.kind not in "biuf":
        raise InvalidFile(path, f"holds {array.dtype} instead of numbers in {where}")
    if array.ndim != n_dims or 0 in array.shape:
        raise InvalidFile(
            path, f"has shape {array.shape} in {where}, which must have {n_dims} dimensions and not be empty"
        )
    return array


def finite_floats(path: Path | str, where: str, values: object, n_dims: int) -> FloatArray:
    """Check as `numbers`, convert to float32, and check that all values are finite."""
    array = numbers(path, where, values, n_dims)
    with np.errstate(over="ignore"):
        floats = array.astype(np.float32)
    if not np.isfinite(floats).all():
        raise InvalidFile(path, f"holds NaN, infinity or a number too large for float32 in {where}")
    return floats


def finite_doubles(path: Path | str, where: str, values: object, n_dims: int) -> NDArray[np.float64]:
    """As `finite_floats`, but float64."""
    doubles = numbers(path, where, values, n_dims).astype(np.float64)
    if not np.isfinite(doubles).all():
        raise InvalidFile(path, f"holds NaN or infinity in {where}")
    return doubles


def numbered_actions(path: Path | str, where: str, values: object, n_actions: int) -> FloatArray:
    """Convert discrete actions, indices (T, N) or (T, N, 1) or already one-hot (T, N, A), to one-hot (T, N, A).

    Raises:
        InvalidFile: if an index is not a whole number in [0, `n_actions`), or an action is not one-hot.
    """
    array = as_array(path, where, values)
    try:
        if array.ndim == 3 and array.shape[2] == n_actions > 1:
            return one_hot_actions(finite_floats(path, where, array, 3), n_actions)
        array = numbers(path, where, array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array, 2)
        chosen = array.astype(np.int64)
        if (chosen != array).any():
            raise InvalidFile(path, f"holds an action that is not a whole number in {where}")
        return one_hot_actions(chosen, n_actions)
    except InvalidAction as error:
        raise InvalidFile(path, f"holds an invalid action in {where} ({error})") from error


#: Limit on the total size that the arrays of an HDF5 file declare.
MAX_BYTES = 16 << 30


class Hdf5File:
    """An open HDF5 file whose arrays are checked before they are read."""

    def __init__(self, path: Path, file: h5py.File, max_bytes: int) -> None:
        self.path, self._file = path, file
        self._remaining, self._limit = max_bytes, max_bytes

    def names(self, group: str = "/") -> list[str]:
        """Names in a group; empty if there is no such group."""
        found = self._find(group)
        return sorted(found) if isinstance(found, h5py.Group) else []

    def is_array(self, name: str) -> bool:
        """Whether there is an array with this name."""
        return isinstance(self._find(name), h5py.Dataset)

    def n_dims(self, name: str) -> int | None:
        """The number of dimensions of an array; None if there is none."""
        found = self._find(name)
        return found.ndim if isinstance(found, h5py.Dataset) else None

    def attribute(self, name: str) -> object:
        """An attribute of the file, or None."""
        return self._file.attrs.get(name)

    def array(self, name: str, n_dims: int) -> h5py.Dataset:
        """An array of numbers, without reading its values.

        Raises:
            MissingPart: if there is no such array.
            InvalidFile: if it does not hold numbers, has other dimensions, or is stored in another file.
            FileTooLarge: if the arrays requested so far declare more than `max_bytes`.
        """
        found = self._find(name)
        if not isinstance(found, h5py.Dataset):
            raise MissingPart(self.path, f"array {name!r}")
        if found.is_virtual or found.external:
            raise InvalidFile(self.path, f"refers to another file for {name}")
        if found.dtype.kind not in "biuf":
            raise InvalidFile(self.path, f"holds {found.dtype} instead of numbers in {name}")
        if found.ndim != n_dims:
            raise InvalidFile(self.path, f"has shape {found.shape} in {name}, which must have {n_dims} dimensions")
        # The size in memory: compressed zeros take almost no space on disk.
        declared = int(np.prod(found.shape, dtype=object)) * max(8, found.dtype.itemsize)
        self._remaining -= declared
        if self._remaining < 0:
            raise FileTooLarge(self.path, f"{name} of shape {found.shape}", self._limit)
        return found

    def _find(self, name: str) -> object:
        """The object with this path, or None; links are not followed."""
        found: object = self._file
        for part in name.strip("/").split("/") if name != "/" else ():
            if not isinstance(found, h5py.Group) or part not in found:
                return None
            if not isinstance(found.get(part, getlink=True), h5py.HardLink):
                raise InvalidFile(self.path, f"has a link at {name}, which is not followed")
            found = found[part]
        return found


@contextmanager
def open_hdf5(path: Path, max_bytes: int = MAX_BYTES) -> Generator[Hdf5File]:
    """Open an HDF5 file for reading. Errors of h5py inside the block are raised as InvalidFile, too.

    Raises:
        InvalidFile: if it is missing, truncated, damaged or not an HDF5 file.
    """
    try:
        with h5py.File(path, "r") as file:
            yield Hdf5File(path, file, max_bytes)
    except FileNotFoundError as error:
        raise InvalidFile(path, "does not exist") from error
    except (OSError, RuntimeError, KeyError, MemoryError) as error:
        raise InvalidFile(path, f"is not a complete HDF5 file ({error})") from error


def rows(data: h5py.Dataset, first: int, last: int) -> NDArray[np.generic]:
    """Read rows [first, last) of an array."""
    return np.asarray(data[first:last])
