import json
import os
import pickle
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import (
    AlreadyExists,
    InvalidFile,
    MissingPart,
    NewerFile,
    NotFinite,
    NotOneHot,
    ShapeError,
    TruncatedFile,
)
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays, in_batches
from mapt.preferences.storage import SegmentFolder, SegmentWriter
from mapt.preferences.storage_layout import SegmentLayout

LAYOUT = SegmentLayout(n_steps=5, n_agents=2, observation_dim=3, action_dim=4)
FULL = SegmentLayout(n_steps=5, n_agents=2, observation_dim=3, action_dim=4, rewards=True, qpos_dim=3, qvel_dim=2)


def segments(lengths, seed=0, discrete=False):
    rng = np.random.default_rng(seed)
    actions = [
        np.eye(4)[rng.integers(4, size=(length, 2))] if discrete else rng.normal(size=(length, 2, 4))
        for length in lengths
    ]
    return SegmentArrays.stack([rng.normal(size=(length, 2, 3)) for length in lengths], actions)


def written(path, lengths=(5, 3, 1, 5), seed=0):
    arrays = segments(lengths, seed)
    with SegmentWriter.create(path, LAYOUT) as writer:
        writer.append(arrays)
    return arrays


def assert_equal(found, expected):
    np.testing.assert_array_equal(found.observations, expected.observations)
    np.testing.assert_array_equal(found.actions, expected.actions)
    np.testing.assert_array_equal(found.mask, expected.mask)


def test_segments_are_read_back_equal(tmp_path):
    arrays = written(tmp_path / "segments")
    folder = SegmentFolder.open(tmp_path / "segments")
    dimensions = (folder.n_steps, folder.n_agents, folder.observation_dim, folder.action_dim)
    assert (len(folder), *dimensions) == (4, 5, 2, 3, 4)
    assert_equal(folder.take(np.arange(4)), arrays)


@given(st.lists(st.integers(0, 3), max_size=12))
def test_take_equals_take_of_arrays_in_memory(tmp_path_factory, indices):
    path = tmp_path_factory.mktemp("any") / "segments"
    arrays = written(path)
    assert_equal(SegmentFolder.open(path).take(indices), arrays.take(np.array(indices, dtype=np.int64)))


@pytest.mark.parametrize("indices", [[0, 4], [-1], [[0]], [0.5], [True]])
def test_index_out_of_range_is_refused(tmp_path, indices):
    written(tmp_path / "segments")
    with pytest.raises(IndexError):
        SegmentFolder.open(tmp_path / "segments").take(indices)


def test_appended_batches_keep_their_order(tmp_path):
    parts = [segments((5, 2), seed=seed) for seed in range(3)]
    with SegmentWriter.create(tmp_path / "segments", LAYOUT) as writer:
        places = [writer.append(part).tolist() for part in parts]
        assert len(writer) == 6
    assert places == [[0, 1], [2, 3], [4, 5]]
    folder = SegmentFolder.open(tmp_path / "segments")
    for place, part in zip(places, parts, strict=True):
        assert_equal(folder.take(place), part)


def test_shorter_segments_are_padded_to_the_layout(tmp_path):
    short = segments((3, 2))
    with SegmentWriter.create(tmp_path / "segments", LAYOUT) as writer:
        writer.append(short)
    found = SegmentFolder.open(tmp_path / "segments").take([0, 1])
    assert found.observations.shape == (2, 5, 2, 3)
    assert found.mask.sum(axis=1).tolist() == [3, 2]
    np.testing.assert_array_equal(found.observations[:, :3], short.observations)
    assert not found.observations[:, 3:].any()


def test_rewards_and_simulator_states_are_stored_exactly(tmp_path):
    arrays, rng = segments((5, 3)), np.random.default_rng(1)
    rewards, qpos, qvel = (rng.normal(size=(2, 5, *shape)) for shape in ((), (3,), (2,)))
    with SegmentWriter.create(tmp_path / "segments", FULL) as writer:
        writer.append(arrays, rewards=rewards, qpos=qpos, qvel=qvel)
    folder = SegmentFolder.open(tmp_path / "segments")
    for found, given_values in ((folder.rewards, rewards), (folder.qpos, qpos), (folder.qvel, qvel)):
        np.testing.assert_array_equal(found([0, 1])[arrays.mask], given_values[arrays.mask])
        assert not found([1])[:, 3:].any()


def test_array_that_is_not_stored_is_refused(tmp_path):
    written(tmp_path / "segments")
    with pytest.raises(MissingPart) as refused:
        SegmentFolder.open(tmp_path / "segments").rewards([0])
    assert "rewards" in refused.value.part


def test_discrete_actions_are_stored_as_indices(tmp_path):
    layout = SegmentLayout(n_steps=5, n_agents=2, observation_dim=3, action_dim=4, discrete=True)
    arrays = segments((5, 3), discrete=True)
    with SegmentWriter.create(tmp_path / "segments", layout) as writer:
        writer.append(arrays)
    assert (tmp_path / "segments" / "actions.bin").stat().st_size == 2 * 5 * 2 * 2
    assert_equal(SegmentFolder.open(tmp_path / "segments").take([0, 1]), arrays)


def test_discrete_actions_must_be_one_hot(tmp_path):
    layout = SegmentLayout(n_steps=5, n_agents=2, observation_dim=3, action_dim=4, discrete=True)
    arrays = segments((5, 3), discrete=True)
    arrays.actions[1, 2, 0] = 0.25
    with pytest.raises(NotOneHot) as refused, SegmentWriter.create(tmp_path / "segments", layout) as writer:
        writer.append(arrays)
    assert refused.value.segment == 1


def test_array_with_the_wrong_shape_is_refused_and_nothing_is_appended(tmp_path):
    with SegmentWriter.create(tmp_path / "segments", FULL) as writer:
        good = {"rewards": np.zeros((1, 5)), "qpos": np.zeros((1, 5, 3)), "qvel": np.zeros((1, 5, 2))}
        with pytest.raises(ShapeError) as refused:
            writer.append(segments((5,)), **{**good, "qvel": np.zeros((1, 5, 3))})
        assert refused.value.name == "qvel"
        with pytest.raises(ShapeError) as refused:
            writer.append(segments((5,)), **{**good, "rewards": None})
        assert refused.value.name == "rewards"
        with pytest.raises(NotFinite) as refused:
            writer.append(segments((5,)), **{**good, "qpos": np.full((1, 5, 3), np.nan)})
        assert (refused.value.name, refused.value.segment) == ("qpos", 0)
        with pytest.raises(ShapeError) as refused:
            writer.append(segments((6,)), rewards=np.zeros((1, 6)), qpos=np.zeros((1, 6, 3)), qvel=np.zeros((1, 6, 2)))
        assert refused.value.name == "observations"
        writer.append(segments((5,)), **good)
    assert len(SegmentFolder.open(tmp_path / "segments")) == 1


def test_folder_may_be_empty(tmp_path):
    with SegmentWriter.create(tmp_path / "segments", LAYOUT) as writer:
        writer.append(segments((5,)).take(np.array([], dtype=np.int64)))
    assert len(SegmentFolder.open(tmp_path / "segments").take([])) == 0


def test_writer_resumes_a_folder(tmp_path):
    first, second = written(tmp_path / "segments"), segments((2, 5), seed=9)
    with SegmentWriter.resume(tmp_path / "segments") as writer:
        assert writer.append(second).tolist() == [4, 5]
    folder = SegmentFolder.open(tmp_path / "segments")
    assert_equal(folder.take(np.arange(4)), first)
    np.testing.assert_array_equal(folder.take([5]).observations, second.observations[1:])


def test_metadata_is_stored(tmp_path):
    with SegmentWriter.create(tmp_path / "segments", LAYOUT, about={"task": "half-cheetah-6x1", "seed": 3}):
        pass
    assert SegmentFolder.open(tmp_path / "segments").about == {"task": "half-cheetah-6x1", "seed": 3}


def test_folder_with_other_files_is_not_overwritten(tmp_path):
    written(tmp_path / "segments")
    with pytest.raises(AlreadyExists):
        SegmentWriter.create(tmp_path / "segments", LAYOUT)
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(AlreadyExists):
        SegmentWriter.create(tmp_path, LAYOUT)
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


def append_and_fail(opened):
    with opened as writer:
        writer.append(segments((5,)))
        raise ZeroDivisionError


def test_exception_before_a_commit_removes_the_folder(tmp_path):
    with pytest.raises(ZeroDivisionError):
        append_and_fail(SegmentWriter.create(tmp_path / "segments", LAYOUT))
    assert not (tmp_path / "segments").exists()


def test_exception_keeps_committed_segments(tmp_path):
    first = written(tmp_path / "segments")
    before = {file.name: file.read_bytes() for file in (tmp_path / "segments").iterdir()}
    with pytest.raises(ZeroDivisionError):
        append_and_fail(SegmentWriter.resume(tmp_path / "segments"))
    assert {file.name: file.read_bytes() for file in (tmp_path / "segments").iterdir()} == before
    assert_equal(SegmentFolder.open(tmp_path / "segments").take(np.arange(4)), first)


KILLED = """
import sys
sys.path.insert(0, {here!r})
from test_storage import LAYOUT, SegmentWriter, segments
writer = SegmentWriter.create({path!r}, LAYOUT)
writer.append(segments((5, 2), seed=0))
writer.commit()
print("committed", flush=True)
while True:
    writer.append(segments((5,) * 50, seed=1))
"""


def test_killed_writer_keeps_committed_segments_and_resumes(tmp_path):
    path = tmp_path / "segments"
    script = KILLED.format(here=os.path.dirname(__file__), path=str(path))
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"committed\n"
        deadline = time.monotonic() + 60
        committed_bytes = 2 * 5 * 2 * 3 * 4
        while (path / "observations.bin").stat().st_size <= committed_bytes:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert_equal(SegmentFolder.open(path).take([0, 1]), segments((5, 2), seed=0))
    with SegmentWriter.resume(path) as writer:
        writer.append(segments((4,), seed=2))
    np.testing.assert_array_equal(
        SegmentFolder.open(path).take([2]).observations[:, :4], segments((4,), seed=2).observations
    )


def test_open_folder_does_not_see_later_commits(tmp_path):
    with SegmentWriter.create(tmp_path / "segments", LAYOUT) as writer:
        writer.append(segments((5, 4)))
        writer.commit()
        folder = SegmentFolder.open(tmp_path / "segments")
        writer.append(segments((5, 4)))
        assert len(folder) == 2
        folder.take([0, 1])


def test_folder_without_a_manifest_is_refused(tmp_path):
    with pytest.raises(MissingPart) as refused:
        SegmentFolder.open(tmp_path)
    assert "manifest.json" in refused.value.part


def test_truncated_file_is_refused(tmp_path):
    written(tmp_path / "segments")
    os.truncate(tmp_path / "segments" / "actions.bin", 100)
    for opened in (SegmentFolder.open, SegmentWriter.resume):
        with pytest.raises(TruncatedFile) as refused:
            opened(tmp_path / "segments")
        assert "actions.bin" in str(refused.value.path)


def test_file_truncated_after_opening_is_refused(tmp_path):
    written(tmp_path / "segments")
    folder = SegmentFolder.open(tmp_path / "segments")
    os.truncate(tmp_path / "segments" / "observations.bin", 100)
    with pytest.raises(TruncatedFile) as refused:
        folder.take([3])
    assert "observations.bin" in str(refused.value.path)


def test_missing_array_file_is_named(tmp_path):
    written(tmp_path / "segments")
    (tmp_path / "segments" / "actions.bin").unlink()
    with pytest.raises(MissingPart) as refused:
        SegmentFolder.open(tmp_path / "segments")
    assert "actions.bin" in refused.value.part


def change_manifest(folder, **changes):
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_newer_schema_version_is_refused(tmp_path):
    written(tmp_path / "segments")
    change_manifest(tmp_path / "segments", schema_version=2)
    with pytest.raises(NewerFile) as refused:
        SegmentFolder.open(tmp_path / "segments")
    assert (refused.value.found, refused.value.known) == (2, 1)


@pytest.mark.parametrize(
    "changes",
    [
        {"format": "something else"},
        {"n_segments": -1},
        {"n_segments": "4"},
        {"schema_version": "one"},
        {"layout": {"n_steps": 5}},
        {"layout": {"n_steps": 0, "n_agents": 2, "observation_dim": 3, "action_dim": 4}},
        {"layout": {"n_steps": 5.5, "n_agents": 2, "observation_dim": 3, "action_dim": 4}},
        {"layout": None},
        {"about": 7},
    ],
)
def test_invalid_manifest_is_refused(tmp_path, changes):
    written(tmp_path / "segments")
    change_manifest(tmp_path / "segments", **changes)
    with pytest.raises(InvalidFile) as refused:
        SegmentFolder.open(tmp_path / "segments")
    assert "manifest.json" in str(refused.value.path)


def test_manifest_that_is_not_json_is_refused(tmp_path):
    written(tmp_path / "segments")
    (tmp_path / "segments" / "manifest.json").write_bytes(b"\xff{")
    with pytest.raises(InvalidFile) as refused:
        SegmentFolder.open(tmp_path / "segments")
    assert "manifest.json" in str(refused.value.path)


def test_lengths_above_the_layout_are_refused(tmp_path):
    written(tmp_path / "segments")
    (tmp_path / "segments" / "lengths.bin").write_bytes(np.array([5, 3, 9, 5], dtype="<i4").tobytes())
    with pytest.raises(InvalidFile) as refused:
        SegmentFolder.open(tmp_path / "segments")
    assert "length" in refused.value.problem


def test_folder_can_be_pickled(tmp_path):
    arrays = written(tmp_path / "segments")
    copied = pickle.loads(pickle.dumps(SegmentFolder.open(tmp_path / "segments")))  # noqa: S301 (our own)
    assert_equal(copied.take([2, 0]), arrays.take([2, 0]))


def test_dataset_on_disk_equals_dataset_in_memory(tmp_path):
    arrays = written(tmp_path / "segments")
    pairs = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [0, 2], [1, 3]])
    labels = np.array([1, 0, 0.5, 1, 1, 0])
    on_disk = PreferenceDataset(SegmentFolder.open(tmp_path / "segments"), pairs, labels)
    in_memory = PreferenceDataset(arrays, pairs, labels)
    for mine, theirs in zip(on_disk.split(0.5, 0), in_memory.split(0.5, 0), strict=True):
        np.testing.assert_array_equal(mine.pairs, theirs.pairs)
        assert_equal(mine.segments.take(mine.pairs[:, 0]), theirs.segments.take(theirs.pairs[:, 0]))


@pytest.mark.parametrize("size", [1, 3, 4, 7])
def test_in_batches_yields_every_segment_once(tmp_path, size):
    arrays = written(tmp_path / "segments")
    parts = list(in_batches(SegmentFolder.open(tmp_path / "segments"), size))
    assert all(len(part) <= size for part in parts)
    np.testing.assert_array_equal(np.concatenate([part.observations for part in parts]), arrays.observations)
