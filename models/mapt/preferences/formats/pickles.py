"""A restricted unpickler for files of other programs: it loads arrays, numbers and containers, and runs no code.

It does not call numpy with unchecked values either: the dtype, shape and bytes of an array are recorded while the
pickle is read, then checked, and made into an array at the end.
"""

import pickle
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray

from mapt.errors import FileTooLarge, InvalidFile, TruncatedFile, UnsafePickle

#: Limit on the size of a pickle, which is read into memory.
MAX_BYTES = 8 << 30
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
        InvalidFile: if it is not a pickle, or holds an invalid array.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise FileTooLarge(path, f"{size} bytes", max_bytes)
        with path.open("rb") as file:
            return _Resolving().resolve(_Unpickler(file, path, classes).load())
    except OSError as error:
        raise InvalidFile(path, f"cannot be read ({error.strerror})") from error
    except EOFError as error:
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
            raise pickle.UnpicklingError(f"dtype {code!r}")
        self.code = code.lstrip("<>|=")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        # (version, byte order, subarray, names, fields, size, alignment, flags)
        byte_order, *structure = state[1:5]
        if byte_order not in ("<", ">", "|", "=") or any(part is not None for part in structure):
            raise pickle.UnpicklingError(f"dtype {state!r}")
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
            raise pickle.UnpicklingError(f"shape {shape!r}")
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
        raise pickle.UnpicklingError(f"bytes encoded as {encoding!r}")
    return text.encode("latin1")


def _refuse(*_arguments: object) -> NoReturn:
    raise pickle.UnpicklingError("an invalid array")


def _checked_bytes(content: object) -> bytes | bytearray:
    # An int would allocate that many bytes.
    if not isinstance(content, bytes | bytearray):
        raise pickle.UnpicklingError("bytes from a value of another type")
    return content


_NDARRAY = _Allowed(_refuse)
_MULTIARRAY = {"_reconstruct": _Allowed(_reconstruct), "scalar": _Allowed(_Scalar)}
_BUILTINS = {
    "bytes": _Allowed(lambda content=b"": bytes(_checked_bytes(content))),
    "bytearray": _Allowed(lambda content=b"": bytes(_checked_bytes(content))),
    "set": _Allowed(lambda items=(): set(items)),
    "frozenset": _Allowed(lambda items=(): frozenset(items)),
}
_ALLOWED: dict[str, Any] = {
    "numpy.ndarray": _NDARRAY,
    "numpy.dtype": _Allowed(_Dtype),
    **{f"numpy.core.multiarray.{name}": call for name, call in _MULTIARRAY.items()},
    **{f"numpy._core.multiarray.{name}": call for name, call in _MULTIARRAY.items()},
    "numpy.core.numeric._frombuffer": _Allowed(_from_buffer),
    "numpy._core.numeric._frombuffer": _Allowed(_from_buffer),
    "_codecs.encode": _Allowed(_latin1),
    "collections.OrderedDict": _Allowed(lambda items=(): dict(items)),
    # Builtins, under their names in Python 3 and Python 2.
    **{f"{module}.{name}": call for module in ("builtins", "__builtin__") for name, call in _BUILTINS.items()},
}


class _Unpickler(pickle.Unpickler):
    """Finds only the globals in `_ALLOWED`, and the classes that the caller names."""

    def __init__(self, file: BinaryIO, path: Path, classes: tuple[str, ...]) -> None:
        super().__init__(file)
        self._path = path
        self._classes = {name: type("Foreign", (_Foreign,), {"name": name, "__slots__": ()}) for name in classes}

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        name = f"{module_name}.{global_name}"
        found = _ALLOWED.get(name) or self._classes.get(name)
        if found is None:
            raise UnsafePickle(self._path, name)
        return found

    def persistent_load(self, pid: object) -> NoReturn:
        raise UnsafePickle(self._path, f"an object outside the file ({pid!r})")


class _Resolving:
    """Replaces the recorded arrays, scalars and instances by real ones; shared objects stay shared."""

    def __init__(self) -> None:
        self._done: dict[int, Any] = {}
        # Keeps the objects alive, so that their ids stay unique.
        self._seen: list[Any] = []

    def resolve(self, value: Any) -> Any:
        if id(value) in self._done:
            return self._done[id(value)]
        self._seen.append(value)
        if isinstance(value, list):
            self._done[id(value)] = value
            value[:] = [self.resolve(each) for each in value]
            return value
        if isinstance(value, dict):
            self._done[id(value)] = value
            items = [(self.resolve(key), self.resolve(each)) for key, each in value.items()]
            value.clear()
            value.update(items)
            return value
        made = self._made(value)
        self._done[id(value)] = made
        return made

    def _made(self, value: Any) -> Any:
        match value:
            case tuple():
                return tuple(self.resolve(each) for each in value)
            case set() | frozenset():
                return type(value)(self.resolve(each) for each in value)
            case _Array():
                return self._array(value)
            case _Scalar():
                return self._scalar(value)
            case _Foreign():
                return Record(value.name, self.resolve(value.fields))
            case _Allowed() | _Dtype() | type():
                raise pickle.UnpicklingError("a function or type instead of data")
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
