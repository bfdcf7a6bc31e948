import pickle
import pickletools
import sys
import types

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from mapt.errors import AlreadyExists
from mapt.preferences.formats.pickle_writer import write_pickle
from mapt.preferences.formats.pickles import Record, load_pickle
from support.comparisons import everything_in

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)
DTYPES = st.sampled_from(["<f4", ">f8", "<i8", "<i4", "|u1", "|b1", "<f2"])


@given(PLAIN)
def test_pickle_loads_written_data(tmp_path_factory, value):
    path = tmp_path_factory.mktemp("plain") / "file.pkl"
    write_pickle(path, value)
    assert pickle.loads(path.read_bytes()) == value  # noqa: S301 (our own)
    assert load_pickle(path) == value


@given(arrays.arrays(DTYPES, arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4)))
def test_numpy_loads_written_arrays(tmp_path_factory, array):
    path = tmp_path_factory.mktemp("array") / "file.pkl"
    write_pickle(path, [array.T])
    for found in (pickle.loads(path.read_bytes()), load_pickle(path)):  # noqa: S301 (our own)
        assert found[0].dtype == array.dtype.newbyteorder("<")
        np.testing.assert_array_equal(found[0], array.T)


@given(st.lists(PLAIN, max_size=4))
def test_numpy_loads_written_arrays_of_objects(tmp_path_factory, values):
    array = np.empty(len(values), dtype=object)
    array[:] = values
    path = tmp_path_factory.mktemp("objects") / "file.pkl"
    write_pickle(path, array)
    for found in (pickle.loads(path.read_bytes()), load_pickle(path)):  # noqa: S301 (our own)
        assert found.dtype == object
        assert found.tolist() == values


def test_written_pickle_refers_only_to_names_that_old_numpy_has(tmp_path):
    write_pickle(tmp_path / "file.pkl", {"a": np.arange(3)})
    names = {
        argument
        for opcode, argument, _ in pickletools.genops((tmp_path / "file.pkl").read_bytes())
        if opcode.name in ("GLOBAL", "STACK_GLOBAL")
    }
    assert names == {"numpy.core.multiarray _reconstruct", "numpy ndarray", "numpy dtype"}


def test_iterator_is_written_as_a_list(tmp_path):
    write_pickle(tmp_path / "file.pkl", ({"n": n} for n in range(3)))
    assert load_pickle(tmp_path / "file.pkl") == [{"n": 0}, {"n": 1}, {"n": 2}]


def test_record_is_written_as_an_instance_of_its_class(tmp_path, monkeypatch):
    class Thing:
        pass

    module = types.ModuleType("not_installed")
    module.Thing = Thing
    write_pickle(tmp_path / "file.pkl", Record("not_installed.Thing", {"x": np.arange(2), "y": [None]}))
    monkeypatch.setitem(sys.modules, "not_installed", module)
    found = pickle.loads((tmp_path / "file.pkl").read_bytes())  # noqa: S301 (our own)
    assert isinstance(found, Thing)
    assert (found.x.tolist(), found.y) == ([0, 1], [None])


@pytest.mark.parametrize("value", [object(), {1: {2}}, np.array(["a"]), np.array([{1}]), [1j]])
def test_unsupported_value_leaves_no_file(tmp_path, value):
    with pytest.raises(TypeError):
        write_pickle(tmp_path / "file.pkl", value)
    assert everything_in(tmp_path) == {}


def test_existing_file_is_not_overwritten(tmp_path):
    (tmp_path / "file.pkl").write_bytes(b"mine")
    with pytest.raises(AlreadyExists):
        write_pickle(tmp_path / "file.pkl", 1)
    assert everything_in(tmp_path) == {"file.pkl": b"mine"}
