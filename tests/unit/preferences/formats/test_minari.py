import json
import os
import warnings

import gymnasium
import h5py
import minari
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from minari.data_collector import EpisodeBuffer

from mapt.errors import AlreadyExists, FileTooLarge, InvalidFile, MissingPart, ShapeError
from mapt.preferences.formats.minari import read_minari, write_minari
from mapt.preferences.formats.records import cut_segments
from support.comparisons import assert_same_episodes, everything_in, made_episodes


def box(size):
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def of_agents(space, names):
    return gymnasium.spaces.Dict(dict.fromkeys(names, space))


def write_by_minari(folder, monkeypatch, names=("agent_2", "agent_10"), lengths=(4, 2), action_space=None, infos=True):
    """A dataset made by Minari, with one agent if there are no names."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    rng, buffers = np.random.default_rng(0), []
    action_space = action_space or box(2)

    def acted(length):
        if isinstance(action_space, gymnasium.spaces.Discrete):
            return rng.integers(action_space.n, size=length)
        return rng.normal(size=(length, 2)).astype(np.float32)

    for index, length in enumerate(lengths):
        observed = {name: rng.normal(size=(length + 1, 3)).astype(np.float32) for name in names or ("",)}
        actions = {name: acted(length) for name in names or ("",)}
        buffers.append(
            EpisodeBuffer(
                id=index,
                observations=observed if names else observed[""],
                actions=actions if names else actions[""],
                rewards=rng.normal(size=length).tolist(),
                terminations=[False] * length,
                truncations=[False] * (length - 1) + [True],
                infos={"qpos": rng.normal(size=(length + 1, 5)), "qvel": rng.normal(size=(length + 1, 4))}
                if infos
                else None,
            )
        )
    with warnings.catch_warnings():
        # Minari warns about missing descriptions, authors and environments.
        warnings.simplefilter("ignore", UserWarning)
        minari.create_dataset_from_buffers(
            "test/agents-v0",
            buffers,
            observation_space=of_agents(box(3), names) if names else box(3),
            action_space=of_agents(action_space, names) if names else action_space,
        )
    return folder / "minari" / "test" / "agents-v0", buffers


def test_dataset_written_by_minari_is_read(tmp_path, monkeypatch):
    path, buffers = write_by_minari(tmp_path, monkeypatch)
    episodes = list(read_minari(path))
    assert [len(episode) for episode in episodes] == [4, 2]
    for episode, buffer in zip(episodes, buffers, strict=True):
        # Agent 2 comes before agent 10; the last observation is dropped.
        for agent, name in enumerate(("agent_2", "agent_10")):
            np.testing.assert_array_equal(episode.observations[:, agent], buffer.observations[name][:-1])
            np.testing.assert_array_equal(episode.actions[:, agent], buffer.actions[name])
        np.testing.assert_array_equal(episode.rewards, buffer.rewards)
        np.testing.assert_array_equal(episode.qpos, buffer.infos["qpos"][:-1])
        np.testing.assert_array_equal(episode.qvel, buffer.infos["qvel"][:-1])


def test_single_agent_dataset_has_one_agent(tmp_path, monkeypatch):
    path, buffers = write_by_minari(tmp_path, monkeypatch, names=(), infos=False)
    first = next(read_minari(path))
    assert first.observations.shape == (4, 1, 3)
    np.testing.assert_array_equal(first.actions[:, 0], buffers[0].actions)
    assert set(first.extras()) == {"rewards"}


def test_discrete_actions_become_one_hot(tmp_path, monkeypatch):
    path, buffers = write_by_minari(tmp_path, monkeypatch, action_space=gymnasium.spaces.Discrete(4))
    first = next(read_minari(path, n_actions=4))
    assert first.actions.shape == (4, 2, 4)
    np.testing.assert_array_equal(first.actions.argmax(axis=-1)[:, 0], buffers[0].actions["agent_2"])
    with pytest.raises(InvalidFile) as refused:
        next(read_minari(path))
    assert "actions" in refused.value.problem


def test_episodes_are_cut_into_segments(tmp_path, monkeypatch):
    path, buffers = write_by_minari(tmp_path, monkeypatch, lengths=(4, 2, 7))
    (records,) = cut_segments(read_minari(path), 2)
    assert len(records) == 2 + 1 + 3
    np.testing.assert_array_equal(records.rewards[2], buffers[1].rewards)


@settings(max_examples=15)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=3), st.sampled_from([1, 2, 11]))
def test_written_data_is_read_back_equal(tmp_path_factory, lengths, n_agents):
    path = tmp_path_factory.mktemp("minari") / "replay-v0"
    episodes = made_episodes(lengths, n_agents=n_agents)
    write_minari(path, episodes, dataset_id="test/replay-v0")
    assert_same_episodes(list(read_minari(path)), episodes)


def test_minari_loads_what_is_written(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episodes = made_episodes([4, 2], n_agents=3)
    write_minari(tmp_path / "test" / "replay-v0", episodes, dataset_id="test/replay-v0")
    dataset = minari.load_dataset("test/replay-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (2, 6)
    assert dataset.observation_space == of_agents(box(3), ("agent_0", "agent_1", "agent_2"))
    for found, episode in zip(dataset, episodes, strict=True):
        for agent in range(3):
            np.testing.assert_array_equal(found.observations[f"agent_{agent}"][:-1], episode.observations[:, agent])
            np.testing.assert_array_equal(found.actions[f"agent_{agent}"], episode.actions[:, agent])
        np.testing.assert_array_equal(found.rewards, episode.rewards)
        np.testing.assert_array_equal(found.infos["qpos"][:-1], episode.qpos)
        assert found.truncations.tolist() == [False] * (len(episode) - 1) + [True]


def test_minari_loads_discrete_actions_that_are_written(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episodes = made_episodes([4, 2], n_agents=2, action_dim=5, discrete=True)
    write_minari(tmp_path / "test" / "replay-v0", episodes, dataset_id="test/replay-v0", discrete=True)
    dataset = minari.load_dataset("test/replay-v0")
    assert dataset.action_space == of_agents(gymnasium.spaces.Discrete(5), ("agent_0", "agent_1"))
    for found, episode in zip(dataset, episodes, strict=True):
        np.testing.assert_array_equal(found.actions["agent_1"], episode.actions[:, 1].argmax(axis=-1))


def test_episodes_of_different_dimensions_leave_nothing(tmp_path):
    for episodes in ([], [*made_episodes([2]), *made_episodes([2], n_agents=2)]):
        with pytest.raises(ShapeError):
            write_minari(tmp_path / "replay-v0", episodes, dataset_id="replay-v0")
    assert list(tmp_path.iterdir()) == []


def test_existing_folder_is_not_overwritten(tmp_path):
    (tmp_path / "mine").touch()
    with pytest.raises(AlreadyExists):
        write_minari(tmp_path, made_episodes([2]), dataset_id="replay-v0")
    assert everything_in(tmp_path) == {"mine": b""}


@pytest.fixture
def dataset(tmp_path):
    write_minari(tmp_path / "replay-v0", made_episodes([4, 2], n_agents=2), dataset_id="replay-v0")
    return tmp_path / "replay-v0"


def change(dataset, name, values):
    with h5py.File(dataset / "data" / "main_data.hdf5", "a") as file:
        del file[name]
        if values is not None:
            file[name] = values


@pytest.mark.parametrize(
    ("name", "values", "problem"),
    [
        ("episode_1", None, MissingPart),
        ("episode_0/rewards", None, MissingPart),
        ("episode_0/rewards", np.zeros(3), InvalidFile),
        ("episode_0/rewards", np.full(4, np.nan), InvalidFile),
        ("episode_0/observations", None, InvalidFile),
        ("episode_0/observations/agent_1", None, InvalidFile),
        ("episode_0/actions/agent_1", None, InvalidFile),
        ("episode_0/observations/agent_1", np.zeros((4, 3)), InvalidFile),
        ("episode_0/observations/agent_1", np.zeros((5, 4)), InvalidFile),
        ("episode_0/observations/agent_1", np.full((5, 3), np.inf), InvalidFile),
        ("episode_0/observations/agent_1", np.zeros((5, 2, 2)), InvalidFile),
        ("episode_0/observations/agent_1", np.full((5, 3), b"x"), InvalidFile),
        ("episode_0/actions/agent_0", np.zeros((3, 2)), InvalidFile),
        ("episode_0/actions", np.zeros((4, 2)), InvalidFile),
        ("episode_1/infos/qpos", np.zeros((1, 5)), InvalidFile),
    ],
)
def test_malformed_dataset_is_refused_and_nothing_changes(dataset, name, values, problem):
    change(dataset, name, values)
    before = everything_in(dataset)
    with pytest.raises(problem) as refused:
        list(read_minari(dataset))
    assert "main_data.hdf5" in str(refused.value.path)
    assert everything_in(dataset) == before


@pytest.mark.parametrize("share", [0.0, 0.2, 0.9])
def test_truncated_file_is_refused(dataset, share):
    path = dataset / "data" / "main_data.hdf5"
    os.truncate(path, int(path.stat().st_size * share))
    with pytest.raises(InvalidFile):
        list(read_minari(dataset))


@pytest.mark.parametrize(
    "changes",
    [{"data_format": "arrow"}, {"total_episodes": 0}, {"total_episodes": "two"}, {"total_episodes": None}],
)
def test_invalid_metadata_is_refused(dataset, changes):
    path = dataset / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(InvalidFile) as refused:
        list(read_minari(dataset))
    assert "metadata.json" in str(refused.value.path)


def test_missing_metadata_is_refused(dataset):
    path = dataset / "data" / "metadata.json"
    for content in (b"{", b"\xff", b"[]", b"{}"):
        path.write_bytes(content)
        with pytest.raises(InvalidFile):
            list(read_minari(dataset))
    path.unlink()
    with pytest.raises(MissingPart) as refused:
        list(read_minari(dataset))
    assert "metadata" in refused.value.part


def test_file_above_the_size_limit_is_not_read(dataset):
    with pytest.raises(FileTooLarge) as refused:
        list(read_minari(dataset, max_bytes=100))
    assert refused.value.limit == 100
