import os
import pickle

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapt.errors import (
    AlreadyExists,
    InvalidFile,
    MissingPart,
    NotRepresentable,
    TruncatedFile,
    UnknownLabel,
    UnsafePickle,
)
from mapt.preferences.formats.offline_labels import LabelFiles, read_offline_labels, write_offline_labels
from support.comparisons import assert_same_segments, everything_in, made_comparisons

LENGTHS = [(6, "terminal"), (5, "timeout"), (5, "timeout"), (4, "nothing")]


def write_trajectories(folder, timeouts=True):
    """Observations are (row, row), which identifies every step."""
    path, n_rows = folder / "d4rl.hdf5", sum(length for length, _ in LENGTHS)
    ends = np.cumsum([length for length, _ in LENGTHS]) - 1
    flags = {
        name: np.isin(np.arange(n_rows), ends[[kind == name for _, kind in LENGTHS]])
        for name in ("terminal", "timeout")
    }
    with h5py.File(path, "w") as file:
        file["observations"] = np.repeat(np.arange(n_rows, dtype=np.float32)[:, None], 2, axis=1)
        file["actions"] = np.zeros((n_rows, 1), dtype=np.float32)
        file["rewards"] = np.arange(n_rows, dtype=np.float32)
        file["terminals"] = flags["terminal"]
        if timeouts:
            file["timeouts"] = flags["timeout"]
    return path


def rows_by_d4rls_own_rule(path, horizon=None):
    """The rows that d4rl.qlearning_dataset keeps, by the same loop."""
    with h5py.File(path) as file:
        terminals, n_rows = file["terminals"][()], len(file["rewards"])
        timeouts = file["timeouts"][()] if "timeouts" in file else None
    kept, episode_step = [], 0
    for row in range(n_rows - 1):
        final = bool(timeouts[row]) if timeouts is not None else episode_step == horizon - 1
        if final:
            episode_step = 0
            continue
        episode_step = 0 if terminals[row] else episode_step + 1
        kept.append(row)
    return kept


def write_labels(folder, labels, first, second):
    for name, values in (("label_human", labels), ("indices_num2_q3", first), ("indices_2_num2_q3", second)):
        (folder / name).write_bytes(pickle.dumps(values))
    return LabelFiles.find(folder)


def read(folder, labels, first, second, n_steps=3, **options):
    path = write_trajectories(folder, timeouts="horizon" not in options)
    return read_offline_labels(path, write_labels(folder, labels, first, second), n_steps, **options)


@pytest.mark.parametrize(
    ("theirs", "ours"), [(0, 1.0), (1, 0.0), (-1, 0.5), ((1, 0), 1.0), ((0.0, 1.0), 0.0), ((0.5, 0.5), 0.5)]
)
def test_labels_are_converted(tmp_path, theirs, ours):
    found = read(tmp_path, np.array([theirs]), [0], [6])
    assert found.labels.tolist() == [ours]
    # Their loaders use it as the target of a cross-entropy over (first, second).
    target = {0: [1, 0], 1: [0, 1], -1: [0.5, 0.5]}.get(theirs, theirs)
    assert list(target) == [ours, 1 - ours]


@pytest.mark.parametrize(
    "labels", [[0, 2], [0.5, 0], [[1, 1], [0, 1]], [[0.7, 0.3], [1, 0]], ["first", "second"], [None, 0]]
)
def test_unknown_label_is_refused(tmp_path, labels):
    with pytest.raises(InvalidFile) as refused:
        read(tmp_path, np.array(labels), [0, 0], [6, 6])
    assert "label" in refused.value.problem


def test_index_of_an_unknown_label_is_reported(tmp_path):
    with pytest.raises(UnknownLabel) as refused:
        read(tmp_path, [0, 2], [0, 0], [6, 6])
    assert refused.value.index == 1


@pytest.mark.parametrize("horizon", [None, 5])
def test_indices_count_the_transitions_of_qlearning_dataset(tmp_path, horizon):
    kept = rows_by_d4rls_own_rule(write_trajectories(tmp_path, timeouts=horizon is None), horizon)
    episode = np.repeat(np.arange(4), [length for length, _ in LENGTHS]) if horizon is None else None
    for place in range(len(kept) - 2):
        rows = kept[place : place + 3]
        if horizon is not None or len(set(episode[rows])) > 1:
            continue
        found = read(tmp_path, [0], [place], [0])
        segment = found.records.segments.take(found.pairs[:, 0])
        assert segment.observations[0, :, 0, 0].tolist() == rows
    if horizon is not None:
        # The first five steps are an episode that timed out: its last step is dropped.
        assert kept[:6] == [0, 1, 2, 3, 5, 6]
        found = read(tmp_path, [0], [1], [5], horizon=horizon)
        rows = found.records.segments.observations[:, :, 0, 0].tolist()
        assert rows == [kept[1:4], kept[5:8]]


def test_first_and_second_are_segments_0_and_1(tmp_path):
    found = read(tmp_path, [0, 1], np.array([0, 6], dtype=np.int32), [2, 0])
    rows = found.records.segments.observations[:, 0, 0, 0][found.pairs]
    assert rows.tolist() == [[0, 2], [6, 0]]
    assert found.records.rewards[found.pairs[1, 0]].tolist() == [6, 7, 8]


@pytest.mark.parametrize(
    ("first", "problem"), [(4, "end of an episode"), (9, "end of an episode"), (100, "of only 17"), (16, "of only 17")]
)
def test_segment_outside_of_an_episode_is_refused(tmp_path, first, problem):
    with pytest.raises(InvalidFile) as refused:
        read(tmp_path, [0], [first], [0])
    assert problem in refused.value.problem


@pytest.mark.parametrize("first", [[0], [0, 0, 0], [-1, 0], [0.5, 0], [[0], [0]], "ab", {"a": 1}])
def test_invalid_indices_are_refused(tmp_path, first):
    with pytest.raises(InvalidFile) as refused:
        read(tmp_path, [0, 1], first, [0, 0])
    assert "indices_num2" in str(refused.value.path)


@pytest.mark.parametrize("name", ["label_human", "indices_num2_q3", "indices_2_num2_q3"])
def test_truncated_and_unsafe_pickles_are_refused(tmp_path, name):
    class Runs:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'ran'}",)

    trajectories, files = write_trajectories(tmp_path), write_labels(tmp_path, np.zeros(2), np.zeros(2), np.zeros(2))
    for content, problem in ((pickle.dumps(np.zeros(2))[:-20], TruncatedFile), (pickle.dumps(Runs()), UnsafePickle)):
        (tmp_path / name).write_bytes(content)
        before = everything_in(tmp_path)
        with pytest.raises(problem):
            read_offline_labels(trajectories, files, 3)
        assert everything_in(tmp_path) == before


def test_files_of_both_projects_are_found(tmp_path):
    for names in (
        ("label_human", "indices_num500_q100", "indices_2_num500_q100"),
        tuple(
            f"{what}_domain_mujoco_env_halfcheetah-medium-v2_num_2000_len_200_7d2759ef.pkl"
            for what in ("human_label", "indices_1", "indices_2")
        ),
    ):
        folder = tmp_path / names[0]
        folder.mkdir()
        for name in names:
            (folder / name).touch()
        files = LabelFiles.find(folder)
        assert (files.labels.name, files.first.name, files.second.name) == names


def test_missing_or_ambiguous_files_are_named(tmp_path):
    with pytest.raises(MissingPart) as refused:
        LabelFiles.find(tmp_path / "nowhere")
    assert "labels" in refused.value.part
    for name in ("label_human", "label_dummy", "indices_num1", "indices_2_num1"):
        (tmp_path / name).touch()
    assert LabelFiles.find(tmp_path).labels.name == "label_human"
    (tmp_path / "labels_of_ada").touch()
    with pytest.raises(InvalidFile) as refused:
        LabelFiles.find(tmp_path)
    assert "label_human, labels_of_ada" in refused.value.problem
    (tmp_path / "labels_of_ada").unlink()
    (tmp_path / "indices_num1").unlink()
    with pytest.raises(MissingPart) as refused:
        LabelFiles.find(tmp_path)
    assert "indices" in refused.value.part


@settings(max_examples=20)
@given(st.lists(st.sampled_from([0.0, 0.5, 1.0]), min_size=1, max_size=4), st.integers(1, 3))
def test_written_data_is_read_back_equal(tmp_path_factory, labels, n_agents):
    folder = tmp_path_factory.mktemp("labels") / "out"
    made = made_comparisons(labels, n_agents=n_agents)
    files = write_offline_labels(folder, made)
    found = read_offline_labels(folder / "trajectories.hdf5", files, 4)
    assert found.labels.tolist() == labels
    order = made.pairs.T.reshape(-1)
    assert_same_segments(found.records.segments, made.records.segments.take(order))
    np.testing.assert_array_equal(found.records.qpos, made.records.qpos[order])


@pytest.mark.parametrize("ours", [1.0, 0.0, 0.5])
def test_written_files_have_the_same_meaning_for_both_projects(tmp_path, ours):
    files = write_offline_labels(tmp_path / "out", made_comparisons([ours]))
    (label,) = pickle.loads(files.labels.read_bytes())  # noqa: S301 (our own)
    assert {0: 1.0, 1: 0.0, -1: 0.5}[int(label)] == ours
    kept = rows_by_d4rls_own_rule(tmp_path / "out" / "trajectories.hdf5")
    (second,) = pickle.loads(files.second.read_bytes())  # noqa: S301 (our own)
    with h5py.File(tmp_path / "out" / "trajectories.hdf5") as file:
        rows = file["observations"][()][kept[second : second + 4]]
    np.testing.assert_array_equal(rows.reshape(4, 2, 3), made_comparisons([ours]).records.segments.observations[1])


def test_data_that_the_format_cannot_represent_is_refused(tmp_path):
    for made in (made_comparisons([0.75]), made_comparisons([1.0], lengths=[2, 4])):
        with pytest.raises(NotRepresentable):
            write_offline_labels(tmp_path / "out", made)
    assert list(tmp_path.iterdir()) == []
    write_offline_labels(tmp_path / "out", made_comparisons([1.0, float("nan")]))
    assert len(read_offline_labels(tmp_path / "out" / "trajectories.hdf5", LabelFiles.find(tmp_path / "out"), 4)) == 1
    with pytest.raises(AlreadyExists):
        write_offline_labels(tmp_path / "out", made_comparisons([1.0]))
