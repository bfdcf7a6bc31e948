import collections
import contextlib
import io
import os
import pickle
import pickletools
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from mapt.errors import FileError, FileTooLarge, InvalidFile, TruncatedFile, UnsafePickle
from mapt.preferences.formats.pickles import Record, load_pickle


def write(folder, content):
    path = folder / "file.pkl"
    path.write_bytes(content)
    return path


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@given(PLAIN, st.integers(0, 5))
def test_containers_are_loaded(tmp_path_factory, value, protocol):
    path = write(tmp_path_factory.mktemp("plain"), pickle.dumps(value, protocol))
    assert load_pickle(path) == value


DTYPES = st.sampled_from(["<f4", ">f8", "<i8", ">i2", "|u1", "|b1", "<c8", "<f2", "<U3", "|S4"])


@given(
    arrays.arrays(DTYPES, arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4)),
    st.integers(0, 5),
    st.booleans(),
)
def test_arrays_are_loaded(tmp_path_factory, array, protocol, fortran):
    array = np.asfortranarray(array) if fortran else array
    path = write(tmp_path_factory.mktemp("array"), pickle.dumps({"a": [array, array]}, protocol))
    first, second = load_pickle(path)["a"]
    assert first is second
    assert first.dtype == array.dtype
    np.testing.assert_array_equal(first, array)


@pytest.mark.parametrize("protocol", range(6))
def test_numpy_scalars_and_object_arrays_are_loaded(tmp_path, protocol):
    value = [np.float32(2.5), np.int64(-1), np.array([{"a": np.arange(3)}, None], dtype=object)]
    found = load_pickle(write(tmp_path, pickle.dumps(value, protocol)))
    assert found[:2] == value[:2]
    assert found[2].dtype == object
    np.testing.assert_array_equal(found[2][0]["a"], [0, 1, 2])


@pytest.mark.parametrize("module", [b"numpy.core.multiarray", b"numpy._core.multiarray"])
def test_arrays_of_old_and_new_numpy_are_loaded(tmp_path, module):
    content = pickle.dumps(np.arange(3.0), 2)
    for name in (b"numpy.core.multiarray", b"numpy._core.multiarray"):
        content = content.replace(b"c" + name + b"\n", b"c" + module + b"\n")
    assert module in content
    np.testing.assert_array_equal(load_pickle(write(tmp_path, content)), np.arange(3.0))


def test_sets_and_ordered_dicts_are_loaded(tmp_path):
    value = (frozenset({1}), {2, 3}, collections.OrderedDict(a=1), bytearray(b"ab"))
    assert load_pickle(write(tmp_path, pickle.dumps(value))) == (frozenset({1}), {2, 3}, {"a": 1}, b"ab")


def test_list_that_contains_itself_is_refused(tmp_path):
    value = [1]
    value.append(value)
    with pytest.raises(InvalidFile, match="contains itself"):
        load_pickle(write(tmp_path, pickle.dumps(value)))


class Runs:
    def __init__(self, function, *arguments):
        self.function, self.arguments = function, arguments

    def __reduce__(self):
        return self.function, self.arguments


@pytest.mark.parametrize("protocol", range(6))
def test_pickle_that_runs_code_is_refused_and_runs_nothing(tmp_path, protocol):
    made = tmp_path / "made-by-the-pickle"
    path = write(tmp_path, pickle.dumps([Runs(os.system, f"touch {made}")], protocol))
    with pytest.raises(UnsafePickle) as refused:
        load_pickle(path)
    assert "posix.system" in refused.value.name
    assert not made.exists()


@pytest.mark.parametrize(
    "value",
    [
        Runs(eval, "1"),
        Runs(getattr, [], "append"),
        Runs(__import__, "os"),
        Runs(io.open, "/etc/passwd"),
        Runs(np.fromfile, "/etc/passwd"),
        Runs(np.load, "/etc/passwd"),
        Runs(np.frombuffer, b"12345678"),
        np.ndarray,
        pickle.Pickler,
        np.random.default_rng(0),
    ],
)
def test_any_other_callable_or_class_is_refused(tmp_path, value):
    with pytest.raises(InvalidFile):
        load_pickle(write(tmp_path, pickle.dumps(value)))


def test_dotted_names_do_not_reach_attributes_of_allowed_globals(tmp_path):
    content = b"\x80\x04\x8c\x05numpy\x8c\x10ndarray.__init__\x93."
    with pytest.raises(UnsafePickle):
        load_pickle(write(tmp_path, content))


def test_allowed_function_cannot_be_changed(tmp_path):
    # BUILD on a function would write into its attributes.
    content = b"\x80\x02cnumpy\ndtype\n}X\x05\x00\x00\x00_callNsb."
    pickletools.dis(content, out=io.StringIO())
    with pytest.raises(InvalidFile) as refused:
        load_pickle(write(tmp_path, content))
    assert "changed" in refused.value.problem
    np.testing.assert_array_equal(load_pickle(write(tmp_path, pickle.dumps(np.arange(2)))), [0, 1])


def test_persistent_ids_are_refused(tmp_path):
    with pytest.raises(UnsafePickle) as refused:
        load_pickle(write(tmp_path, b"Psomething\n."))
    assert "outside" in refused.value.name


def array_pickle(shape, dtype=("f8", False, True), content=b"", state_dtype=None):
    """A pickle of an array whose declared state need not match its content."""

    class Dtype:
        def __reduce__(self):
            return np.dtype, dtype, state_dtype or (3, "<", None, None, None, -1, -1, 0)

    class Array:
        def __reduce__(self):
            reconstruct = np.arange(2).__reduce__()[0]
            return reconstruct, (np.ndarray, (0,), b"b"), (1, shape, Dtype(), False, content)

    return pickle.dumps(Array(), 2)


def test_hand_written_array_is_loaded(tmp_path):
    path = write(tmp_path, array_pickle((2,), content=struct.pack("<2d", 1, 2)))
    assert load_pickle(path).tolist() == [1, 2]


@pytest.mark.parametrize(
    "content",
    [
        array_pickle((1 << 40,)),
        array_pickle((1 << 62, 1 << 62)),
        array_pickle((-1,)),
        array_pickle((3,), content=bytes(16)),
        array_pickle((2,), ("V16", False, True), content=bytes(32)),
        array_pickle((2,), ("f8", False, True), bytes(16), (3, "|", None, ("a",), {"a": 1}, -1, -1, 0)),
        array_pickle((2,), ("(1000000,1000000)f8", False, True)),
        array_pickle((2,), ("O8", False, True), bytes(16), (3, "|", None, None, None, -1, -1, 63)),
        array_pickle((2,), ("O8", False, True), [1], (3, "|", None, None, None, -1, -1, 63)),
    ],
)
def test_inconsistent_array_is_refused(tmp_path, content):
    with pytest.raises(InvalidFile):
        load_pickle(write(tmp_path, content))


def test_large_shape_in_the_constructor_allocates_nothing(tmp_path):
    class Huge:
        def __reduce__(self):
            return np.arange(2).__reduce__()[0], (np.ndarray, (1 << 36,), b"d")

    with pytest.raises(InvalidFile):
        load_pickle(write(tmp_path, pickle.dumps(Huge(), 2)))


def test_bytearray_of_a_size_allocates_nothing(tmp_path):
    with pytest.raises(InvalidFile):
        load_pickle(write(tmp_path, pickle.dumps(Runs(bytearray, 1 << 40))))


def test_memo_index_of_a_billion_allocates_nothing(tmp_path):
    assert load_pickle(write(tmp_path, b"\x80\x02]r\xff\xff\xff\xff.")) == []


def test_pickle_that_is_nested_too_deeply_is_refused(tmp_path):
    with pytest.raises(InvalidFile):
        load_pickle(write(tmp_path, b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b"."))


def doubled(value, times, pair=lambda each: (each, each)):
    """Pairs of pairs of pairs ... of one object: a pickle of a few bytes per pair stands for 2 ** times objects."""
    for _ in range(times):
        value = pair(value)
    return value


def doubled_pickle(times):
    """The pickle of `doubled((), times)`, which pickle itself would write after 2 ** times comparisons."""
    return b"\x80\x04)" + b"".join(b"\x94h%c\x86" % index for index in range(times))


def test_shared_lists_stay_shared(tmp_path):
    first, second = load_pickle(write(tmp_path, pickle.dumps(doubled([np.arange(3)], 16, lambda each: [each, each]))))
    assert first is second


# In their first versions, each of these pickles of less than 500 bytes took minutes and more.
@pytest.mark.parametrize(
    "content",
    [
        doubled_pickle(60) + b".",
        b"\x80\x04]" + doubled_pickle(60)[2:] + b"a.",
        b"\x80\x04}" + doubled_pickle(60)[2:] + b"Ns.",
        b"\x80\x04}(" + doubled_pickle(60)[2:] + b"Nu.",
        b"\x80\x04(" + doubled_pickle(60)[2:] + b"Nd.",
        b"\x80\x04\x8f(" + doubled_pickle(60)[2:] + b"\x90.",
        b"\x80\x04(" + doubled_pickle(60)[2:] + b"\x91.",
        b"\x80\x04cbuiltins\nset\n]" + doubled_pickle(60)[2:] + b"a\x85R.",
        b"\x80\x04ccollections\nOrderedDict\n]" + doubled_pickle(60)[2:] + b"N\x86a\x85R.",
        b"\x80\x04cnumpy\ndtype\n" + doubled_pickle(60)[2:] + b"\x89\x88\x87R.",
        b"\x80\x04" + doubled_pickle(60)[2:] + b"Q.",
    ],
    ids=["tuple", "list", "key", "keys", "dict", "set", "frozenset", "set call", "dict call", "dtype", "persistent id"],
)
def test_a_small_pickle_that_stands_for_a_trillion_objects_is_refused(tmp_path, content):
    assert len(content) < 500
    with pytest.raises(InvalidFile):
        load_pickle(write(tmp_path, content))


def test_arrays_that_are_shared_too_often_are_refused(tmp_path):
    path = write(tmp_path, pickle.dumps([np.zeros(1000)] * 1000))
    assert len(load_pickle(path)) == 1000
    with pytest.raises(InvalidFile, match="shared so often"):
        load_pickle(path, max_bytes=7_999_999)


@pytest.mark.parametrize("key", [tuple(range(17)), (1, (2,)), frozenset({(1,)}), 1 << 65])
def test_keys_that_take_long_to_hash_are_refused(tmp_path, key):
    for value in ({key: 1}, {key}):
        with pytest.raises(InvalidFile, match="a key"):
            load_pickle(write(tmp_path, pickle.dumps(value)))
    assert load_pickle(write(tmp_path, pickle.dumps({(0, "a"): 1}))) == {(0, "a"): 1}


def test_bytearray_that_is_longer_than_the_file_allocates_nothing(tmp_path):
    with pytest.raises(TruncatedFile):
        load_pickle(write(tmp_path, b"\x80\x05\x96" + struct.pack("<Q", 1 << 40) + b"."))


@given(st.data())
def test_pickle_truncated_anywhere_is_refused(tmp_path_factory, data):
    content = pickle.dumps([{"obs": np.arange(40.0), "label": 1}] * 3)
    end = data.draw(st.integers(0, len(content) - 1))
    with pytest.raises(InvalidFile):
        load_pickle(write(tmp_path_factory.mktemp("cut"), content[:end]))


def test_pickle_truncated_in_an_array_is_reported_as_truncated(tmp_path):
    content = pickle.dumps(np.arange(1000.0))
    with pytest.raises(TruncatedFile):
        load_pickle(write(tmp_path, content[:500]))


@given(st.binary(max_size=60))
def test_random_bytes_raise_an_error_or_load_as_data(tmp_path_factory, content):
    with contextlib.suppress(FileError):
        load_pickle(write(tmp_path_factory.mktemp("noise"), content))


@given(st.data())
def test_pickle_with_a_changed_byte_raises_an_error_or_loads_as_data(tmp_path_factory, data):
    content = bytearray(pickle.dumps([{"obs": np.arange(6.0).reshape(2, 3), "label": np.int64(1)}], 2))
    content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(FileError):
        load_pickle(write(tmp_path_factory.mktemp("changed"), bytes(content)))


def test_file_above_the_size_limit_is_not_read(tmp_path):
    path = write(tmp_path, pickle.dumps(np.arange(1000)))
    with pytest.raises(FileTooLarge) as refused:
        load_pickle(path, max_bytes=100)
    assert refused.value.limit == 100


def test_missing_file_is_named(tmp_path):
    with pytest.raises(InvalidFile) as refused:
        load_pickle(tmp_path / "nowhere.pkl")
    assert "nowhere" in str(refused.value.path)


class Foreign:
    def __init__(self):
        self.obs = np.arange(3)
        self.next = [np.float32(1)]

    def __setstate__(self, state):
        raise AssertionError("code of the class ran")


def test_instance_of_an_allowed_class_is_loaded_as_its_fields(tmp_path):
    path = write(tmp_path, pickle.dumps([Foreign()]))
    name = f"{Foreign.__module__}.Foreign"
    with pytest.raises(UnsafePickle):
        load_pickle(path)
    (found,) = load_pickle(path, (name,))
    assert isinstance(found, Record)
    assert found.name == name
    assert found.fields["obs"].tolist() == [0, 1, 2]
    assert found.fields["next"] == [1]


def test_allowed_class_is_neither_called_nor_loaded_itself(tmp_path):
    name = f"{Foreign.__module__}.Foreign"
    for value in (Runs(Foreign), Foreign):
        with pytest.raises(InvalidFile):
            load_pickle(write(tmp_path, pickle.dumps(value)), (name,))
