import os

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapt.errors import AlreadyExists, FileTooLarge, InvalidFile, MissingPart, ShapeError
from mapt.preferences.formats.d4rl import read_d4rl, write_d4rl
from mapt.preferences.formats.records import AgentIndices
from support.comparisons import assert_same_episodes, everything_in, made_episodes

# An episode of 4 steps that terminates, one of 3 that times out, and the beginning of a third.
TERMINALS, TIMEOUTS = [0, 0, 0, 1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 1, 0, 0]


def arrays():
    """Write a file in the layout of D4RL."""
    rng = np.random.default_rng(0)
    return {
        "observations": rng.normal(size=(9, 6)).astype(np.float32),
        "actions": rng.normal(size=(9, 2)).astype(np.float32),
        "rewards": rng.normal(size=9).astype(np.float32),
        "terminals": np.array(TERMINALS, dtype=bool),
        "timeouts": np.array(TIMEOUTS, dtype=bool),
        "infos/qpos": rng.normal(size=(9, 5)),
        "infos/qvel": rng.normal(size=(9, 4)),
        "infos/action_log_probs": rng.normal(size=9),
        "metadata/algorithm": np.bytes_(b"SAC"),
    }


def write(folder, **changes):
    path = folder / "d4rl.hdf5"
    with h5py.File(path, "w") as file:
        for name, values in {**arrays(), **changes}.items():
            if values is not None:
                file[name] = values
    return path


def test_d4rl_file_is_read_as_episodes(tmp_path):
    episodes, whole = list(read_d4rl(write(tmp_path))), arrays()
    assert [len(episode) for episode in episodes] == [4, 3, 2]
    second = episodes[1]
    np.testing.assert_array_equal(second.observations[:, 0], whole["observations"][4:7])
    np.testing.assert_array_equal(second.actions[:, 0], whole["actions"][4:7])
    np.testing.assert_array_equal(second.rewards, whole["rewards"][4:7].astype(np.float64))
    np.testing.assert_array_equal(second.qpos, whole["infos/qpos"][4:7])
    np.testing.assert_array_equal(second.qvel, whole["infos/qvel"][4:7])


def test_missing_rewards_and_states_are_none(tmp_path):
    path = write(tmp_path, **{"infos/qpos": None, "infos/qvel": None})
    assert set(next(read_d4rl(path)).extras()) == {"rewards"}


def test_agent_indices_split_observations_and_actions(tmp_path):
    agents = AgentIndices(observations=[[0, 5], [1, 5]], actions=[[1], [0]])
    episode, whole = next(read_d4rl(write(tmp_path), agents=agents)), arrays()
    assert episode.observations.shape == (4, 2, 2)
    np.testing.assert_array_equal(episode.observations[:, 1], whole["observations"][:4, [1, 5]])
    np.testing.assert_array_equal(episode.actions[:, 0, 0], whole["actions"][:4, 1])


def test_agent_indices_out_of_range_are_refused(tmp_path):
    with pytest.raises(InvalidFile) as refused:
        list(read_d4rl(write(tmp_path), agents=AgentIndices([[6]], [[0]])))
    assert "indices" in refused.value.problem


def test_file_without_timeouts_needs_the_horizon(tmp_path):
    path = write(tmp_path, timeouts=None)
    with pytest.raises(MissingPart) as refused:
        list(read_d4rl(path))
    assert "timeouts" in refused.value.part
    assert [len(episode) for episode in read_d4rl(path, horizon=3)] == [3, 1, 3, 2]


@settings(max_examples=30)
@given(
    st.lists(st.integers(1, 9), min_size=1, max_size=4),
    st.integers(1, 3),
    st.sets(st.sampled_from(["rewards", "qpos", "qvel"])),
)
def test_written_data_is_read_back_equal(tmp_path_factory, lengths, n_agents, known):
    path = tmp_path_factory.mktemp("d4rl") / "d4rl.hdf5"
    episodes = made_episodes(lengths, n_agents=n_agents, known=tuple(known))
    write_d4rl(path, episodes)
    assert_same_episodes(list(read_d4rl(path)), episodes)


def test_written_file_has_the_arrays_of_d4rl(tmp_path):
    write_d4rl(tmp_path / "d4rl.hdf5", made_episodes([3, 2], n_agents=2))
    with h5py.File(tmp_path / "d4rl.hdf5") as file:
        shapes = {name: file[name].shape for name in arrays() if name in file}
        assert file["timeouts"][()].tolist() == [False, False, True, False, True]
        assert not file["terminals"][()].any()
    assert shapes == {
        "observations": (5, 6),
        "actions": (5, 4),
        "rewards": (5,),
        "terminals": (5,),
        "timeouts": (5,),
        "infos/qpos": (5, 5),
        "infos/qvel": (5, 4),
    }


def test_episodes_of_different_dimensions_leave_no_file(tmp_path):
    for other in (made_episodes([2], n_agents=2), made_episodes([2], known=())):
        for episodes in ([*made_episodes([2]), *other], [*other, *made_episodes([2])], []):
            with pytest.raises(ShapeError):
                write_d4rl(tmp_path / "d4rl.hdf5", episodes)
    assert everything_in(tmp_path) == {}


def test_existing_file_is_not_overwritten(tmp_path):
    path = write(tmp_path)
    before = everything_in(tmp_path)
    with pytest.raises(AlreadyExists):
        write_d4rl(path, made_episodes([2]))
    assert everything_in(tmp_path) == before


@pytest.mark.parametrize("name", ["observations", "actions", "terminals"])
def test_missing_array_is_named(tmp_path, name):
    with pytest.raises(MissingPart) as refused:
        list(read_d4rl(write(tmp_path, **{name: None})))
    assert name in refused.value.part


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("observations", np.zeros((9, 2, 3))),
        ("observations", np.zeros((0, 6))),
        ("observations", np.full((9, 6), np.nan)),
        ("observations", np.full((9, 6), b"x")),
        ("actions", np.zeros((8, 2))),
        ("rewards", np.zeros((9, 1))),
        ("rewards", np.full(9, np.inf)),
        ("timeouts", np.zeros(10, dtype=bool)),
        ("infos/qpos", np.zeros((3, 5))),
        ("infos/qvel", np.full((9, 4), np.nan)),
    ],
)
def test_array_with_the_wrong_shape_is_refused_and_nothing_changes(tmp_path, name, values):
    path = write(tmp_path, **{name: values})
    before = everything_in(tmp_path)
    with pytest.raises(InvalidFile) as refused:
        list(read_d4rl(path))
    assert "d4rl.hdf5" in str(refused.value.path)
    assert everything_in(tmp_path) == before


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.95])
def test_truncated_file_is_refused(tmp_path, share):
    path = write(tmp_path)
    os.truncate(path, int(path.stat().st_size * share))
    with pytest.raises(InvalidFile):
        list(read_d4rl(path))


def test_missing_file_is_named(tmp_path):
    with pytest.raises(InvalidFile) as refused:
        list(read_d4rl(tmp_path / "nowhere.hdf5"))
    assert "nowhere" in str(refused.value.path)


def test_array_that_declares_a_terabyte_is_not_read(tmp_path):
    path = write(tmp_path, observations=None)
    with h5py.File(path, "a") as file:
        file.create_dataset("observations", shape=(1 << 34, 8), dtype="f8", chunks=(1 << 10, 8))
    assert path.stat().st_size < 100_000
    with pytest.raises(FileTooLarge) as refused:
        list(read_d4rl(path))
    assert "observations" in refused.value.what


def test_links_and_arrays_in_other_files_are_not_read(tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(9 * 6 * 8))
    with h5py.File(tmp_path / "other.hdf5", "w") as file:
        file["observations"] = np.zeros((9, 6))
    for kind in ("external", "link", "soft", "virtual"):
        path = write(tmp_path, observations=None)
        with h5py.File(path, "a") as file:
            if kind == "external":
                place = [(str(secret), 0, h5py.h5f.UNLIMITED)]
                file.create_dataset("observations", shape=(9, 6), dtype="f8", external=place)
            elif kind == "link":
                file["observations"] = h5py.ExternalLink(str(tmp_path / "other.hdf5"), "/observations")
            elif kind == "soft":
                file["observations"] = h5py.SoftLink("/infos/qpos")
            else:
                layout = h5py.VirtualLayout(shape=(9, 6), dtype="f8")
                layout[:] = h5py.VirtualSource(str(tmp_path / "other.hdf5"), "observations", shape=(9, 6))
                file.create_virtual_dataset("observations", layout)
        with pytest.raises(InvalidFile):
            list(read_d4rl(path))


@pytest.mark.parametrize("n_agents", [0, -1, 4, "two", 2.5])
def test_invalid_number_of_agents_is_refused(tmp_path, n_agents):
    path = write(tmp_path)
    with h5py.File(path, "a") as file:
        file.attrs["mapt_n_agents"] = n_agents
    with pytest.raises(InvalidFile) as refused:
        list(read_d4rl(path))
    assert "agents" in refused.value.problem
