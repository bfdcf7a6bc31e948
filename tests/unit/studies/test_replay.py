"""A replay is found whole or not at all, and known by its numbers."""

import numpy as np
import pytest

from mapt.preferences.errors import FileError
from mapt.preferences.storage import SegmentLayout, SegmentWriter
from mapt.studies.errors import NoTrueRewards, ReplayNotFound
from mapt.studies.replay import Replay
from unit.studies.tiny_replay import N_SEGMENTS, N_STEPS, write_replay


def test_a_replay_gives_what_was_written(replay):
    assert len(replay) == N_SEGMENTS
    assert replay.rewards.shape == replay.mask.shape == (N_SEGMENTS, N_STEPS)
    np.testing.assert_allclose(
        replay.rewards[[5, 2]], replay.segments([5, 2]).observations[..., 0].mean(axis=2), atol=1e-6
    )
    np.testing.assert_allclose(replay.returns, replay.rewards.sum(axis=1))


def test_a_view_is_the_chosen_segments_in_their_order(replay):
    view = replay.view([7, 3, 11])
    assert len(view) == 3
    dimensions = (view.n_steps, view.n_agents, view.observation_dim, view.action_dim)
    assert dimensions == (N_STEPS, 2, 3, 1)
    np.testing.assert_array_equal(view.take([2, 0]).observations, replay.segments([11, 7]).observations)


def test_the_fingerprint_is_that_of_the_numbers_wherever_they_lie(tmp_path):
    first, copy = write_replay(tmp_path / "a"), write_replay(tmp_path / "b")
    assert first.fingerprint() == copy.fingerprint() != write_replay(tmp_path / "c", seed=1).fingerprint()


def test_one_number_makes_another_fingerprint(replay):
    before = replay.fingerprint()
    with (replay.path / "actions.bin").open("r+b") as file:
        file.seek(-4, 2)
        file.write(np.float32(1.5).tobytes())
    assert replay.fingerprint() != before


def test_an_empty_folder_is_no_replay(tmp_path):
    with pytest.raises(ReplayNotFound, match="mapt dataset"):
        Replay.open(tmp_path)


def test_a_replay_cut_short_is_refused(replay):
    with (replay.path / "rewards.bin").open("r+b") as file:
        file.truncate(100)
    with pytest.raises(FileError):
        Replay.open(replay.path)


def test_segments_without_true_rewards_are_no_replay(tmp_path, replay):
    with SegmentWriter.create(tmp_path / "bare", SegmentLayout(N_STEPS, 2, 3, 1)) as writer:
        writer.append(replay.segments(range(4)))
    with pytest.raises(NoTrueRewards):
        Replay.open(tmp_path / "bare")
