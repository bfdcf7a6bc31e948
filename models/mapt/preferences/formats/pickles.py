"""A restricted unpickler for files of other programs: it loads arrays, numbers and containers, and runs no code.

It does not call numpy with unchecked values either: the dtype, shape and bytes of an array are recorded while the
pickle is read, then checked, and made into an array at the end.

A pickle may refer to one object from many places, so that a few bytes stand for an amount of data that nothing could
compare, copy or print. Keys, which are hashed while the pickle is read, must be simple; of everything else, the extent
with every reference written out is limited. Python's own unpickler is used, because that in C cannot be told of keys.
"""

import pickle
import re
import reprlib
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, NoReturn

import numpy as np
from numpy.typing import NDArray

from mapt.errors import FileTooLarge, InvalidFile, TruncatedFile, UnsafePickle

#: Limit on the size of a pickle, which is read into memory.
MAX_BYTES = 8 << 30
#: Objects that a smaller pickle may stand for, with every reference written out.
MAX_OBJECTS = 10_000_000
#: Parts of a tuple, and bits of a whole number, that is a key.
_MAX_KEY_PARTS, _MAX_KEY_BITS = 16, 64
#: bool, integers, floats, complex, bytes, text, object
_DTYPE = re.compile(r"[<>|=]?(?:[biufcSU?]\d{0,9}|O8?)")


@dataclass(frozen=True, slots=True)
class Record:
    """An instance of a class that is not imported: the name of the class, and the fields."""

    name: str
    fields: Mapping[str, Any]


def load_pickle(path: Path | str, classes: tuple[str, ...] = (), *, max_bytes: int = MAX_BYTES) -> Any:
    """Load None, bool, numbers, str, bytes, list, tuple, dict, set, numpy arrays and scalars from a pickle.

    Args:
        classes: "module.Class" names whose instances are allowed; they are returned as `Record`s.

    Raises:
        UnsafePickle: if the pickle refers to anything else.
        FileTooLarge: if the file has more than `max_bytes`.
        TruncatedFile: if the file ends too early.
        InvalidFile: if it is not a pickle, holds an invalid array, contains itself, or stands for more than
            `MAX_OBJECTS` objects (or one per byte) or more than `max_bytes` of arrays.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise FileTooLarge(path, f"{size} bytes", max_bytes)
        with path.open("rb") as file:
            found = _Unpickler(_Limited(file, size), path, classes).load()
        return _Resolving(max(size, MAX_OBJECTS), max_bytes).resolve(found)
    except OSError as error:
        raise InvalidFile(path, f"cannot be read ({error.strerror})") from error
    except (EOFError, struct.error) as error:
        raise TruncatedFile(path) from error
    except pickle.UnpicklingError as error:
        if "truncated" in str(error):
            raise TruncatedFile(path) from error
        raise InvalidFile(path, f"is not a pickle of data ({error})") from error
    except InvalidFile:
        raise
    except RecursionError as error:
        raise InvalidFile(path, "is nested too deeply") from error
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, MemoryError) as error:
        raise InvalidFile(path, f"is not a pickle of data ({type(error).__name__}: {error})") from error


class _Allowed:
    """A callable that a pickle may refer to. The pickle cannot change its state."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        self._call = call

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)

    def __setstate__(self, _state: object) -> NoReturn:
        raise pickle.UnpicklingError("a function cannot be changed")


class _Dtype:
    """Replaces np.dtype: records the arguments of `dtype.__reduce__`, for simple types only."""

    __slots__ = ("code",)

    def __init__(self, code: object, *_flags: object) -> None:
        if not isinstance(code, str) or not _DTYPE.fullmatch(code):
            raise pickle.UnpicklingError(f"dtype {reprlib.repr(code)}")
        self.code = code.lstrip("<>|=")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        # (version, byte order, subarray, names, fields, size, alignment, flags)
        byte_order, *structure = state[1:5]
        if byte_order not in ("<", ">", "|", "=") or any(part is not None for part in structure):
            raise pickle.UnpicklingError(f"dtype {reprlib.repr(state)}")
        self.code = byte_order + self.code

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self.code)


class _Array:
    """Replaces an array while the pickle is read."""

    __slots__ = ("state",)

    def __init__(self) -> None:
        self.state: tuple[Any, ...] = ()

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        # (version, shape, dtype, Fortran order, bytes or a list of objects)
        self.state = state[-4:]

    def parts(self) -> tuple[tuple[int, ...], np.dtype[Any], bool, Any]:
        """The checked state: (shape, dtype, Fortran order, bytes or list)."""
        shape, dtype, fortran, content = self.state
        if not isinstance(dtype, _Dtype) or not isinstance(shape, tuple):
            raise pickle.UnpicklingError("an array without a dtype")
        if not all(isinstance(length, int) and length >= 0 for length in shape):
            raise pickle.UnpicklingError(f"shape {reprlib.repr(shape)}")
        return shape, dtype.dtype, bool(fortran), content


class _Scalar:
    """Replaces a numpy scalar while the pickle is read."""

    __slots__ = ("content", "dtype")

    def __init__(self, dtype: object, content: object) -> None:
        if not isinstance(dtype, _Dtype):
            raise pickle.UnpicklingError("a scalar without a dtype")
        self.dtype, self.content = dtype, content


class _Foreign:
    """Replaces an instance of an allowed class; records its state."""

    name = ""
    __slots__ = ("fields",)

    def __init__(self) -> None:
        raise pickle.UnpicklingError("a class cannot be called")

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
            raise pickle.UnpicklingError(f"{self.name} without named fields")
        self.fields = state


def _reconstruct(kind: object, shape: object, _code: object) -> _Array:
    if kind is not _NDARRAY or shape != (0,):
        raise pickle.UnpicklingError("an invalid array")
    return _Array()


def _from_buffer(content: object, dtype: object, shape: object, order: object) -> _Array:
    array = _Array()
    array.state = (shape, dtype, order == "F", content)
    return array


def _latin1(text: object, encoding: object) -> bytes:
    # Protocols 0 to 2 encode bytes this way.
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes encoded as {reprlib.repr(encoding)}")
    return text.encode("latin1")


def _refuse(*_arguments: object) -> NoReturn:
    raise pickle.UnpicklingError("an invalid array")


def _checked_bytes(content: object) -> bytes | bytearray:
    # An int would allocate that many bytes.
    if not isinstance(content, bytes | bytearray):
        raise pickle.UnpicklingError("bytes from a value of another type")
    return content


def _checked_key(key: Any) -> Any:
    """The key of a dict or element of a set, if it is quick to hash and compare."""
    parts = key if isinstance(key, tuple | frozenset) else (key,)
    if len(parts) > _MAX_KEY_PARTS or any(isinstance(part, tuple | frozenset) for part in parts):
        raise pickle.UnpicklingError("a key that holds other containers, or too many values")
    if any(isinstance(part, int) and part.bit_length() > _MAX_KEY_BITS for part in parts):
        raise pickle.UnpicklingError(f"a key of more than {_MAX_KEY_BITS} bits")
    return key


def _checked_keys(items: Any) -> list[Any]:
    return [_checked_key(each) for each in items]


_NDARRAY = _Allowed(_refuse)
_MULTIARRAY = {"_reconstruct": _Allowed(_reconstruct), "scalar": _Allowed(_Scalar)}
_BUILTINS = {
    "bytes": _Allowed(lambda content=b"": bytes(_checked_bytes(content))),
    "bytearray": _Allowed(lambda content=b"": bytes(_checked_bytes(content))),
    "set": _Allowed(lambda items=(): set(_checked_keys(items))),
    "frozenset": _Allowed(lambda items=(): frozenset(_checked_keys(items))),
}
_ALLOWED: dict[str, Any] = {
    "numpy.ndarray": _NDARRAY,
    "numpy.dtype": _Allowed(_Dtype),
    **{f"numpy.core.multiarray.{name}": call for name, call in _MULTIARRAY.items()},
    **{f"numpy._core.multiarray.{name}": call for name, call in _MULTIARRAY.items()},
    "numpy.core.numeric._frombuffer": _Allowed(_from_buffer),
    "numpy._core.numeric._frombuffer": _Allowed(_from_buffer),
    "_codecs.encode": _Allowed(_latin1),
    "collections.OrderedDict": _Allowed(lambda items=(): {_checked_key(key): value for key, value in items}),
    # Builtins, under their names in Python 3 and Python 2.
    **{f"{module}.{name}": call for module in ("builtins", "__builtin__") for name, call in _BUILTINS.items()},
}


class _Limited:
    """A file that refuses to read more than it holds, instead of allocating it."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size
        self.readline = file.readline

    def read(self, n_bytes: int) -> bytes:
        if n_bytes > self._size - self._file.tell():
            raise EOFError
        return self._file.read(n_bytes)

    def readinto(self, _buffer: object) -> NoReturn:
        raise pickle.UnpicklingError("a buffer")


#: by code
_OPCODES: dict[int, Callable[..., None]] = dict(pickle._Unpickler.dispatch)  # pyright: ignore[reportPrivateUsage]


def _with_checked_keys(opcode: bytes, keys: slice) -> Callable[["_Unpickler"], None]:
    """Python's method for an opcode, after a check of the keys at these places of the stack since the last mark."""

    def load(unpickler: "_Unpickler") -> None:
        _checked_keys(unpickler.stack[keys])
        _OPCODES[opcode[0]](unpickler)

    return load


class _Unpickler(pickle._Unpickler):  # pyright: ignore[reportPrivateUsage]
    """Finds only the globals in `_ALLOWED`, and the classes that the caller names. Checks keys before hashing them."""

    stack: list[Any]
    read: Callable[[int], bytes]

    def __init__(self, file: _Limited, path: Path, classes: tuple[str, ...]) -> None:
        super().__init__(file)
        self._path = path
        self._classes = {name: type("Foreign", (_Foreign,), {"name": name, "__slots__": ()}) for name in classes}

    def find_class(self, module: str, name: str) -> Any:
        name = f"{module}.{name}"
        found = _ALLOWED.get(name) or self._classes.get(name)
        if found is None:
            raise UnsafePickle(self._path, name)
        return found

    def persistent_load(self, pid: object) -> NoReturn:
        raise UnsafePickle(self._path, f"an object outside the file ({reprlib.repr(pid)})")

    def _bytearray(self) -> None:
        # The inherited method allocates before it reads.
        (length,) = struct.unpack("<Q", self.read(8))
        self.stack.append(bytearray(self.read(length)))

    dispatch: ClassVar[dict[int, Callable[..., None]]] = {
        **_OPCODES,
        pickle.SETITEM[0]: _with_checked_keys(pickle.SETITEM, slice(-2, -1)),
        pickle.SETITEMS[0]: _with_checked_keys(pickle.SETITEMS, slice(0, None, 2)),
        pickle.DICT[0]: _with_checked_keys(pickle.DICT, slice(0, None, 2)),
        pickle.ADDITEMS[0]: _with_checked_keys(pickle.ADDITEMS, slice(None)),
        pickle.FROZENSET[0]: _with_checked_keys(pickle.FROZENSET, slice(None)),
        pickle.BYTEARRAY8[0]: _bytearray,
    }


@dataclass(frozen=True, slots=True)
class _Resolved:
    """An object, and its extent with every reference written out."""

    value: Any
    n_objects: int
    n_bytes: int


class _Resolving:
    """Replaces the recorded arrays, scalars and instances by real ones; shared objects stay shared."""

    def __init__(self, max_objects: int, max_bytes: int) -> None:
        self._max_objects, self._max_bytes = max_objects, max_bytes
        #: by id; None for objects whose parts are being resolved
        self._done: dict[int, _Resolved | None] = {}
        # Keeps the objects alive, so that their ids stay unique.
        self._seen: list[Any] = []
        #: extent so far of the object that is being resolved
        self._n_objects = self._n_bytes = 0

    def resolve(self, value: Any) -> Any:
        if id(value) not in self._done:
            self._done[id(value)] = self._resolved(value)
        done = self._done[id(value)]
        if done is None:
            raise pickle.UnpicklingError("an object that contains itself")
        self._n_objects += done.n_objects
        self._n_bytes += done.n_bytes
        if self._n_objects > self._max_objects or self._n_bytes > self._max_bytes:
            raise pickle.UnpicklingError(
                f"objects shared so often that they stand for more than {self._max_objects} objects or "
                f"{self._max_bytes} bytes"
            )
        return done.value

    def _resolved(self, value: Any) -> _Resolved:
        self._seen.append(value)
        self._done[id(value)] = None
        outer = self._n_objects, self._n_bytes
        self._n_objects, self._n_bytes = 1, 0
        made = self._made(value)
        if isinstance(made, np.ndarray):
            self._n_bytes += made.nbytes
        found = _Resolved(made, self._n_objects, self._n_bytes)
        self._n_objects, self._n_bytes = outer
        return found

    def _made(self, value: Any) -> Any:
        match value:
            case list():
                value[:] = [self.resolve(each) for each in value]
            case dict():
                items = [(_checked_key(self.resolve(key)), self.resolve(each)) for key, each in value.items()]
                value.clear()
                value.update(items)
            case tuple():
                return tuple(self.resolve(each) for each in value)
            case set() | frozenset():
                return type(value)(_checked_key(self.resolve(each)) for each in value)
            case _Array():
                return self._array(value)
            case _Scalar():
                return self._scalar(value)
            case _Foreign():
                return Record(value.name, self.resolve(value.fields))
            case _Allowed() | _Dtype() | type():
                raise pickle.UnpicklingError("a function or type instead of data")
            case _:
                pass
        return value

    def _array(self, array: _Array) -> NDArray[Any]:
        shape, dtype, fortran, content = array.parts()
        if dtype.hasobject:
            if not isinstance(content, list):
                raise pickle.UnpicklingError("an object array without a list")
            made = np.empty(len(content), dtype=object)
            for index, each in enumerate(content):
                made[index] = self.resolve(each)
        else:
            made = np.frombuffer(_checked_bytes(content), dtype)
        return made.reshape(shape, order="F" if fortran else "C")

    def _scalar(self, scalar: _Scalar) -> Any:
        dtype = scalar.dtype.dtype
        if dtype.hasobject:
            return self.resolve(scalar.content)
        return np.frombuffer(_checked_bytes(scalar.content), dtype).reshape(())[()]
