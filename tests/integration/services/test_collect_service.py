"""Collecting segments: the arrays are stored as a blob, the rest as a row."""

import mujoco
import numpy as np
import pytest

from accord.domain.errors import BlobMissing, Invalid
from accord.services import collect
from accord.store.tables import SegmentRow
from support.sample_experiments import create_sample, segment
from support.stores import Stores


def test_arrays_are_read_back_equal(stores: Stores) -> None:
    sample = create_sample(stores.database, stores.blobs, segments=0, queries=0)
    rng = np.random.default_rng(0)
    new = collect.NewSegment(
        observations=rng.normal(size=(7, 6, 9)).astype(np.float32),
        actions=rng.normal(size=(7, 6, 1)).astype(np.float32),
        rewards=rng.normal(size=7),
        qpos=rng.normal(size=(7, 9)),
        qvel=rng.normal(size=(7, 9)),
        policy_iteration=3,
        policy_steps=1234,
    )
    stored = collect.store_arrays(stores.blobs, sample.experiment.id, new)
    with stores.database.transaction() as session:
        collect.collect(session, sample.experiment.id, [stored])
    with stores.database.reading() as session:
        row = session.get(SegmentRow, stored.id)
        assert row is not None
        assert (row.policy_iteration, row.policy_steps, row.length_steps) == (3, 1234, 7)
        assert row.true_return == new.rewards.sum()
        assert row.mujoco_version == mujoco.__version__
        arrays = collect.load_arrays(stores.blobs, row.blob_key)
    assert set(arrays) == {"observations", "actions", "rewards", "qpos", "qvel"}
    for name, array in arrays.items():
        expected = getattr(new, name)
        assert array.dtype == expected.dtype
        np.testing.assert_array_equal(array, expected)


def test_arrays_of_different_lengths_are_refused(sqlite: Stores) -> None:
    new = segment()
    with pytest.raises(Invalid) as caught:
        collect.store_arrays(
            sqlite.blobs,
            "exp",
            collect.NewSegment(new.observations, new.actions, new.rewards, new.qpos[1:], new.qvel, 0, 0),
        )
    assert caught.value.field == "qpos"


def test_array_with_a_number_that_is_not_finite_is_refused(sqlite: Stores) -> None:
    with pytest.raises(Invalid) as caught:
        collect.store_arrays(sqlite.blobs, "exp", segment(reward=float("nan")))
    assert caught.value.field == "rewards"


def test_error_for_a_missing_blob_names_its_key(sqlite: Stores) -> None:
    with pytest.raises(BlobMissing) as caught:
        collect.load_arrays(sqlite.blobs, "segments/x")
    assert caught.value.key == "segments/x"
