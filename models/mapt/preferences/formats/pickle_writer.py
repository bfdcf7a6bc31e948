"""Write pickles for other programs: arrays that any version of numpy loads, and instances of uninstalled classes.

Python's pickler writes arrays under module names that numpy before 1.26 lacks, and cannot write instances of classes
that it cannot import. This writer streams, so that a list may be larger than memory.
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

#: numpy's flags of the dtype of Python objects
_FLAGS_OF_OBJECTS = np.dtype(object).flags


def write_pickle(path: Path, value: object) -> None:
    """Write None, bool, int, float, str, bytes, list, tuple, dict, arrays of numbers or of these, and `Record`s.

    An iterator is written as a list, one element at a time.

    Raises:
        AlreadyExists: if the file exists.
        TypeError: for a value of another type. No file is left.
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
            raise TypeError(f"A value of type {type(value).__name__} cannot be written to a pickle for other programs.")


def _array(array: NDArray[Any]) -> Iterator[bytes]:
    """The opcodes of `ndarray.__reduce__`: an empty array, then version, shape, dtype, order, and bytes or a list."""
    if array.dtype.kind not in "biufO":
        raise TypeError(f"An array of {array.dtype} cannot be written to a pickle for other programs.")
    objects = array.dtype.kind == "O"
    little = array if objects else array.astype(array.dtype.newbyteorder("<"))
    # numpy 2 keeps this alias of numpy._core.multiarray for old pickles.
    yield _global("numpy.core.multiarray", "_reconstruct")
    yield pickle.MARK + _global("numpy", "ndarray")
    yield from _pieces((0,))
    yield from _pieces(b"b")
    yield pickle.TUPLE + pickle.REDUCE
    yield pickle.MARK
    yield from _pieces(1)
    yield from _pieces(array.shape)
    yield _global("numpy", "dtype")
    yield from _pieces(("O8" if objects else little.dtype.str[1:], False, True))
    yield pickle.REDUCE
    order = "|" if objects or little.dtype.itemsize == 1 else "<"
    yield from _pieces((3, order, None, None, None, -1, -1, _FLAGS_OF_OBJECTS if objects else 0))
    yield pickle.BUILD
    yield from _pieces(False)
    yield from _pieces(little.reshape(-1).tolist() if objects else little.tobytes())
    yield pickle.TUPLE + pickle.BUILD


def _global(module: str, name: str) -> bytes:
    return pickle.GLOBAL + f"{module}\n{name}\n".encode()
