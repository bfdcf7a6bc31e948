"""Tests against files written by imitation itself (see fixtures/make_imitation.py)."""

import json
import os
import pickle
import shutil
import sys
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapt.errors import (
    AlreadyExists,
    FileError,
    FileTooLarge,
    InvalidFile,
    MissingPart,
    ShapeError,
    TruncatedFile,
    UnknownLabel,
    UnsafePickle,
)
from mapt.preferences.formats.imitation import (
    read_imitation,
    read_imitation_trajectories,
    write_imitation,
    write_imitation_trajectories,
)
from mapt.preferences.formats.pickle_writer import write_pickle
from mapt.preferences.formats.pickles import Record
from support.comparisons import (
    assert_same_episodes,
    assert_same_segments,
    everything_in,
    made_comparisons,
    made_episodes,
)

FIXTURES = Path(__file__).parent / "fixtures"
DATASET = "imitation.algorithms.preference_comparisons.PreferenceDataset"
FRAGMENT = "imitation.data.types.TrajectoryWithRew"


def test_file_written_by_imitation_is_read():
    found = read_imitation(FIXTURES / "imitation_preferences.pkl")
    assert found.labels.tolist() == [1.0, 0.0, 0.5]
    for pair, sides in enumerate(found.pairs):
        for side, segment in enumerate(sides):
            observed = found.records.segments.observations[segment]
            assert observed[:, 1].tolist() == [[pair, side, step] for step in range(4)]
            assert found.records.segments.actions[segment][:, 0].tolist() == [[-step, pair] for step in range(4)]
            assert found.records.rewards[segment].tolist() == [10 * pair + step for step in range(4)]


def test_file_of_one_agent_with_discrete_actions_is_read():
    found = read_imitation(FIXTURES / "imitation_numbered.pkl", n_actions=3)
    assert found.labels.tolist() == [0.25, 1.0]
    assert found.records.segments.observations.shape == (4, 4, 1, 3)
    assert found.records.segments.actions[0].argmax(axis=-1)[:, 0].tolist() == [0, 1, 2, 0]
    with pytest.raises(InvalidFile) as refused:
        read_imitation(FIXTURES / "imitation_numbered.pkl", n_actions=2)
    assert "is not one of 0 to 1" in refused.value.problem


@settings(max_examples=25)
@given(
    st.lists(st.sampled_from([0.0, 0.5, 1.0, 0.125]), min_size=1, max_size=5),
    st.integers(1, 3),
    st.integers(0, 3),
)
def test_written_preferences_are_read_back_equal(tmp_path_factory, labels, n_agents, seed):
    path = tmp_path_factory.mktemp("imitation") / "preferences.pkl"
    lengths = np.random.default_rng(seed).integers(1, 5, size=2 * len(labels)).tolist()
    made = made_comparisons(labels, n_agents=n_agents, lengths=lengths, known=("rewards",))
    write_imitation(path, made)
    found = read_imitation(path)
    assert found.labels.tolist() == labels
    order = made.pairs.T.reshape(-1)
    assert_same_segments(found.records.segments, made.records.segments.take(order))
    mask = found.records.segments.mask
    np.testing.assert_array_equal(
        found.records.rewards[mask], made.records.take(order).rewards[:, : mask.shape[1]][mask]
    )


def test_imitation_loads_written_preferences(tmp_path, monkeypatch):
    """Stand-ins with the names and fields of imitation's classes, which cannot be installed here."""

    @dataclass(frozen=True)
    class TrajectoryWithRew:
        obs: Any
        acts: Any
        infos: Any
        terminal: bool
        rews: Any

    class PreferenceDataset:
        pass

    for name, thing in (("algorithms.preference_comparisons", PreferenceDataset), ("data.types", TrajectoryWithRew)):
        module = types.ModuleType(f"imitation.{name}")
        setattr(module, thing.__name__, thing)
        monkeypatch.setitem(sys.modules, f"imitation.{name}", module)
    monkeypatch.setitem(sys.modules, "imitation", types.ModuleType("imitation"))
    made = made_comparisons([1.0, 0.0, float("nan")], lengths=[4, 3, 2, 1, 1, 1])
    write_imitation(tmp_path / "preferences.pkl", made)
    found = pickle.loads((tmp_path / "preferences.pkl").read_bytes())  # noqa: S301 (our own)
    assert found.preferences.dtype == np.float32
    # P(fragment 1 preferred), where fragment 1 is segment 0; the skip is left out.
    assert found.preferences.tolist() == [1.0, 0.0]
    assert [len(fragment.acts) for fragment in found.fragments1] == [4, 2]
    first = found.fragments1[0]
    np.testing.assert_array_equal(first.obs[:-1], made.records.segments.observations[0])
    np.testing.assert_array_equal(first.obs[-1], first.obs[-2])
    np.testing.assert_array_equal(first.rews, made.records.rewards[0])


def fragment(**changes):
    fields = {"obs": np.zeros((4, 2, 3)), "acts": np.zeros((3, 2, 1)), "infos": None, "terminal": False}
    return Record(FRAGMENT, {**fields, "rews": np.zeros(3), **changes})


def without(name):
    fields = dict(fragment().fields)
    del fields[name]
    return Record(FRAGMENT, fields)


def write(folder, first=None, labels=(1.0,), **changes):
    fields = {"fragments1": [first or fragment()], "fragments2": [fragment()], "max_size": None}
    path = folder / "preferences.pkl"
    path.unlink(missing_ok=True)
    write_pickle(path, Record(DATASET, {**fields, "preferences": np.array(labels), **changes}))
    return path


def of_objects(values):
    array = np.empty(len(values), dtype=object)
    array[:] = values
    return array


STATE = {"qpos": np.zeros(2), "qvel": np.zeros(1), "step": 3}


def test_states_in_infos_are_read(tmp_path):
    infos = of_objects([{**STATE, "qpos": np.array([step, 0.5])} for step in range(3)])
    path = write(tmp_path, fragment(infos=infos), fragments2=[fragment(infos=[STATE] * 3)])
    records = read_imitation(path).records
    assert records.qpos[0].tolist() == [[step, 0.5] for step in range(3)]
    assert records.qvel.shape == (2, 3, 1)


@pytest.mark.parametrize("infos", [None, [], [STATE] * 2, [STATE, STATE, {"step": 3}], [1, 2, 3], np.zeros(3)])
def test_segments_have_no_states_unless_every_step_has_one(tmp_path, infos):
    path = write(tmp_path, fragment(infos=infos), fragments2=[fragment(infos=[STATE] * 3)])
    assert read_imitation(path).records.extras().keys() == {"rewards"}


@pytest.mark.parametrize("qpos", ["here", np.zeros(3), np.zeros((2, 1)), np.array([np.nan, 0])])
def test_states_that_are_not_vectors_of_numbers_are_refused(tmp_path, qpos):
    with pytest.raises(InvalidFile) as refused:
        read_imitation(write(tmp_path, fragment(infos=[STATE, STATE, {**STATE, "qpos": qpos}])))
    assert "qpos in infos of fragments1[0]" in refused.value.problem


@pytest.mark.parametrize("label", [-1.0, 1.5, float("nan")])
def test_unknown_label_is_refused(tmp_path, label):
    with pytest.raises(UnknownLabel) as refused:
        read_imitation(write(tmp_path, labels=[label]))
    assert refused.value.index == 0


@pytest.mark.parametrize(
    ("first", "problem"),
    [
        (without("obs"), MissingPart),
        (without("rews"), MissingPart),
        (fragment(obs=np.zeros((3, 2, 3))), InvalidFile),
        (fragment(obs=np.zeros((4, 3, 3))), InvalidFile),
        (fragment(obs=np.zeros((4, 2, 2, 3))), InvalidFile),
        (fragment(obs=np.full((4, 2, 3), np.nan)), InvalidFile),
        (fragment(obs={"image": np.zeros((4, 3))}), InvalidFile),
        (fragment(rews=np.zeros((3, 1))), InvalidFile),
        (fragment(acts=np.zeros((0, 2, 1))), InvalidFile),
        (fragment(obs=np.zeros((4, 2, 5))), ShapeError),
        (Record(DATASET, {}), InvalidFile),
        ("fragment", InvalidFile),
    ],
)
def test_malformed_file_is_refused_and_nothing_changes(tmp_path, first, problem):
    path = write(tmp_path, first)
    before = everything_in(tmp_path)
    with pytest.raises(problem):
        read_imitation(path)
    assert everything_in(tmp_path) == before


def test_other_pickles_are_refused(tmp_path):
    for changes in ({"fragments2": []}, {"fragments1": None}, {"preferences": np.zeros((1, 2))}, {"labels": []}):
        with pytest.raises(FileError):
            read_imitation(write(tmp_path, **changes))
    (tmp_path / "preferences.pkl").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(InvalidFile) as refused:
        read_imitation(tmp_path / "preferences.pkl")
    assert "PreferenceDataset" in refused.value.problem


def test_truncated_file_is_refused(tmp_path):
    path = tmp_path / "preferences.pkl"
    path.write_bytes((FIXTURES / "imitation_preferences.pkl").read_bytes()[:2000])
    with pytest.raises(TruncatedFile):
        read_imitation(path)


def test_pickle_that_runs_code_is_refused_and_runs_nothing(tmp_path):
    class Runs:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'ran'}",)

    (tmp_path / "preferences.pkl").write_bytes(pickle.dumps(Runs()))
    with pytest.raises(UnsafePickle) as refused:
        read_imitation(tmp_path / "preferences.pkl")
    assert "system" in refused.value.name
    assert not (tmp_path / "ran").exists()


def test_other_classes_of_imitation_are_refused(tmp_path):
    write_pickle(tmp_path / "preferences.pkl", Record("imitation.data.types.DictObs", {"_d": {}}))
    with pytest.raises(UnsafePickle) as refused:
        read_imitation(tmp_path / "preferences.pkl")
    assert "DictObs" in refused.value.name


def test_existing_file_is_not_overwritten(tmp_path):
    (tmp_path / "preferences.pkl").write_bytes(b"mine")
    with pytest.raises(AlreadyExists):
        write_imitation(tmp_path / "preferences.pkl", made_comparisons([1.0]))
    assert everything_in(tmp_path) == {"preferences.pkl": b"mine"}


FIXTURE = Path(__file__).parent / "fixtures" / "imitation_trajectories"


def test_folder_written_by_imitation_is_read():
    episodes = list(read_imitation_trajectories(FIXTURE))
    assert [len(episode) for episode in episodes] == [4, 4]
    for number, episode in enumerate(episodes):
        assert episode.observations[:, 1].tolist() == [[number, 0, step] for step in range(4)]
        assert episode.actions[:, 0].tolist() == [[-step, number] for step in range(4)]
        assert episode.rewards.tolist() == [10 * number + step for step in range(4)]


@settings(max_examples=20)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=4), st.integers(1, 3), st.booleans())
def test_written_trajectories_are_read_back_equal(tmp_path_factory, lengths, n_agents, rewarded):
    path = tmp_path_factory.mktemp("imitation") / "trajectories"
    episodes = made_episodes(lengths, n_agents=n_agents, known=("rewards",) if rewarded else ())
    write_imitation_trajectories(path, episodes)
    assert_same_episodes(list(read_imitation_trajectories(path)), episodes)


def test_written_folder_has_the_layout_of_imitation(tmp_path):
    write_imitation_trajectories(tmp_path / "out", made_episodes([3], n_agents=2, known=("rewards",)))
    assert {file.name for file in (tmp_path / "out").iterdir()} == {file.name for file in FIXTURE.iterdir()}
    mine, theirs = (
        {name: json.loads((folder / name).read_text()) for name in ("state.json", "dataset_info.json")}
        for folder in (tmp_path / "out", FIXTURE)
    )
    assert mine["state.json"].keys() == theirs["state.json"].keys()
    assert mine["dataset_info.json"]["features"].keys() == theirs["dataset_info.json"]["features"].keys()


def test_discrete_actions_become_one_hot(tmp_path):
    copy(tmp_path, {"obs": [[[0.0], [1.0], [2.0]]], "acts": [[2, 0]]})
    (episode,) = read_imitation_trajectories(tmp_path / "copy", n_actions=3)
    assert episode.actions[:, 0].tolist() == [[0, 0, 1], [1, 0, 0]]
    assert episode.rewards is None


def copy(folder, columns):
    """A copy of the folder written by imitation, with other columns."""
    shutil.copytree(FIXTURE, folder / "copy")
    table = pa.table(columns)
    path = folder / "copy" / "data-00000-of-00001.arrow"
    path.unlink()
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, table.schema) as stream:
        stream.write_table(table)


GOOD = {"obs": [[[0.0], [1.0], [2.0]]], "acts": [[[0.0], [0.0]]], "rews": [[1.0, 2.0]]}


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"obs": None}, MissingPart),
        ({"acts": None}, MissingPart),
        ({"obs": [[[0.0], [1.0]]]}, InvalidFile),
        ({"obs": [[[0.0], [1.0, 2.0], [3.0]]]}, InvalidFile),
        ({"obs": [[[0.0], [1.0], [None]]]}, InvalidFile),
        ({"obs": [[[0.0], None, [1.0]]]}, InvalidFile),
        ({"obs": [[[0.0], [1.0], [float("nan")]]]}, InvalidFile),
        ({"obs": [[["a"], ["b"], ["c"]]]}, InvalidFile),
        ({"obs": [1.0]}, InvalidFile),
        ({"obs": [None]}, InvalidFile),
        ({"obs": [[]]}, InvalidFile),
        ({"rews": [[1.0]]}, InvalidFile),
        ({"rews": [[[1.0], [2.0]]]}, InvalidFile),
        ({"acts": [[[[0.0]], [[0.0]]]], "obs": [[[[0.0], [1.0]]] * 3]}, InvalidFile),
    ],
)
def test_malformed_folder_is_refused_and_nothing_changes(tmp_path, changes, problem):
    copy(tmp_path, {name: values for name, values in {**GOOD, **changes}.items() if values is not None})
    before = everything_in(tmp_path)
    with pytest.raises(problem):
        list(read_imitation_trajectories(tmp_path / "copy"))
    assert everything_in(tmp_path) == before


@settings(max_examples=60)
@given(st.data())
def test_file_truncated_anywhere_is_refused(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("cut") / "copy"
    shutil.copytree(FIXTURE, folder)
    path = folder / "data-00000-of-00001.arrow"
    size = path.stat().st_size
    # At a message boundary, or anywhere else.
    os.truncate(path, data.draw(st.sampled_from([1232, size - 8]) | st.integers(0, size - 1)))
    with pytest.raises(InvalidFile):
        list(read_imitation_trajectories(folder))


@pytest.mark.parametrize(
    "state", [{}, [], {"_data_files": []}, {"_data_files": [{"filename": "../../secret"}]}, {"_data_files": [{}]}]
)
def test_invalid_state_file_is_refused(tmp_path, state):
    shutil.copytree(FIXTURE, tmp_path / "copy")
    (tmp_path / "copy" / "state.json").write_text(json.dumps(state))
    with pytest.raises(InvalidFile) as refused:
        list(read_imitation_trajectories(tmp_path / "copy"))
    assert "state.json" in str(refused.value.path)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(MissingPart) as refused:
        list(read_imitation_trajectories(tmp_path))
    assert "state.json" in refused.value.part
    shutil.copytree(FIXTURE, tmp_path / "copy")
    (tmp_path / "copy" / "data-00000-of-00001.arrow").unlink()
    with pytest.raises(MissingPart) as refused:
        list(read_imitation_trajectories(tmp_path / "copy"))
    assert "data-00000" in refused.value.part


def test_file_above_the_size_limit_is_not_read():
    with pytest.raises(FileTooLarge):
        list(read_imitation_trajectories(FIXTURE, max_bytes=100))


def test_episodes_of_different_dimensions_leave_nothing(tmp_path):
    for episodes in ([], [*made_episodes([2]), *made_episodes([2], known=())]):
        with pytest.raises(ShapeError):
            write_imitation_trajectories(tmp_path / "out", episodes)
    assert list(tmp_path.iterdir()) == []


def test_existing_folder_is_not_overwritten(tmp_path):
    (tmp_path / "mine").touch()
    with pytest.raises(AlreadyExists):
        write_imitation_trajectories(tmp_path, made_episodes([2]))
    assert everything_in(tmp_path) == {"mine": b""}
