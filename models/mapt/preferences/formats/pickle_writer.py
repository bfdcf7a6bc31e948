"""Pickles for other programs: arrays and containers under the names that old and new numpy both know, and instances of
classes that are not installed here.

Python's own pickler writes arrays of numpy 2 under names that numpy before 1.26 has not, and refuses a class that it
cannot import. What is written here needs neither, and comes piece by piece, so that a list may be longer than the
memory.
"""

import pickle
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapt.errors import AlreadyExists
from mapt.io import atomic_path
from mapt.preferences.formats.pickles import Record


def write_pickle(path: Path, value: object) -> None:
    """Write None, bool, int, float, str, bytes, list, tuple, dict, numeric arrays and `Record`s of these.

    An iterator is written as a list while it is drawn from.

    Raises:
        AlreadyExists: if there is a file.
        TypeError: for a value of another type. No file is left then.
    """
    if path.exists():
        raise AlreadyExists(path)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(pickle.PROTO + b"\x04")
        for piece in _pieces(value):
            file.write(piece)
        file.write(pickle.STOP)


def _pieces(value: object) -> Iterator[bytes]:
    match value:
        case np.ndarray():
            yield from _array(value)
        case Record():
            yield _global(*value.name.rsplit(".", 1)) + pickle.EMPTY_TUPLE + pickle.NEWOBJ
            yield from _pieces(dict(value.fields))
            yield pickle.BUILD
        case dict():
            yield pickle.EMPTY_DICT + pickle.MARK
            for key, each in value.items():
                yield from _pieces(key)
                yield from _pieces(each)
            yield pickle.SETITEMS
        case tuple():
            yield pickle.MARK
            for each in value:
                yield from _pieces(each)
            yield pickle.TUPLE
        case list() | Iterator():
            yield pickle.EMPTY_LIST + pickle.MARK
            for each in value:
                yield from _pieces(each)
            yield pickle.APPENDS
        case _:
            yield _atom(value)


def _atom(value: object) -> bytes:
    match value:
        case None:
            return pickle.NONE
        case bool():
            return pickle.NEWTRUE if value else pickle.NEWFALSE
        case int():
            encoded = pickle.encode_long(value)
            return pickle.LONG4 + struct.pack("<i", len(encoded)) + encoded
        case float():
            return pickle.BINFLOAT + struct.pack(">d", value)
        case str():
            encoded = value.encode()
            return pickle.BINUNICODE8 + struct.pack("<Q", len(encoded)) + encoded
        case bytes():
            return pickle.BINBYTES8 + struct.pack("<Q", len(value)) + value
        case _:
            raise TypeError(f"{type(value).__name__} has no place in a pickle for others")


def _array(array: NDArray[Any]) -> Iterator[bytes]:
    """As numpy's own `__reduce__`: an empty array, then its version, shape, dtype, order and bytes."""
    if array.dtype.kind not in "biuf":
        raise TypeError(f"an array of {array.dtype} has no place in a pickle for others")
    little = array.astype(array.dtype.newbyteorder("<"))
    # What numpy 2 calls numpy._core.multiarray keeps its old name for just this.
    yield _global("numpy.core.multiarray", "_reconstruct")
    yield pickle.MARK + _global("numpy", "ndarray")
    yield from _pieces((0,))
    yield from _pieces(b"b")
    yield pickle.TUPLE + pickle.REDUCE
    yield pickle.MARK
    yield from _pieces(1)
    yield from _pieces(array.shape)
    yield _global("numpy", "dtype")
    yield from _pieces((little.dtype.str[1:], False, True))
    yield pickle.REDUCE
    order = "|" if little.dtype.itemsize == 1 else "<"
    yield from _pieces((3, order, None, None, None, -1, -1, 0))
    yield pickle.BUILD
    yield from _pieces(False)
    yield from _pieces(little.tobytes())
    yield pickle.TUPLE + pickle.BUILD


def _global(module: str, name: str) -> bytes:
    return pickle.GLOBAL + f"{module}\n{name}\n".encode()
