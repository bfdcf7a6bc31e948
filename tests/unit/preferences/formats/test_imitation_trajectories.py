"""Against a folder that imitation's own code wrote (fixtures/make_imitation.py)."""

import json
import os
import shutil
from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapt.errors import AlreadyExists, FileTooLarge, InvalidFile, MissingPart, ShapeError
from mapt.preferences.formats.imitation_trajectories import read_imitation_trajectories, write_imitation_trajectories
from support.comparing import assert_same_episodes, everything_in, made_episodes

FIXTURE = Path(__file__).parent / "fixtures" / "imitation_trajectories"


def test_a_folder_of_imitations_own_gives_its_trajectories():
    episodes = list(read_imitation_trajectories(FIXTURE))
    assert [len(episode) for episode in episodes] == [4, 4]
    for number, episode in enumerate(episodes):
        assert episode.observations[:, 1].tolist() == [[number, 0, step] for step in range(4)]
        assert episode.actions[:, 0].tolist() == [[-step, number] for step in range(4)]
        assert episode.rewards.tolist() == [10 * number + step for step in range(4)]


@settings(max_examples=20)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=4), st.integers(1, 3), st.booleans())
def test_what_is_written_is_read_back(tmp_path_factory, lengths, n_agents, rewarded):
    path = tmp_path_factory.mktemp("imitation") / "trajectories"
    episodes = made_episodes(lengths, n_agents=n_agents, known=("rewards",) if rewarded else ())
    write_imitation_trajectories(path, episodes)
    assert_same_episodes(list(read_imitation_trajectories(path)), episodes)


def test_what_is_written_is_laid_out_as_imitations_own(tmp_path):
    write_imitation_trajectories(tmp_path / "out", made_episodes([3], n_agents=2, known=("rewards",)))
    assert {file.name for file in (tmp_path / "out").iterdir()} == {file.name for file in FIXTURE.iterdir()}
    mine, theirs = (
        {name: json.loads((folder / name).read_text()) for name in ("state.json", "dataset_info.json")}
        for folder in (tmp_path / "out", FIXTURE)
    )
    assert mine["state.json"].keys() == theirs["state.json"].keys()
    assert mine["dataset_info.json"]["features"].keys() == theirs["dataset_info.json"]["features"].keys()


def test_numbered_actions_become_one_hot(tmp_path):
    copy(tmp_path, {"obs": [[[0.0], [1.0], [2.0]]], "acts": [[2, 0]]})
    (episode,) = read_imitation_trajectories(tmp_path / "copy", n_actions=3)
    assert episode.actions[:, 0].tolist() == [[0, 0, 1], [1, 0, 0]]
    assert episode.rewards is None


def copy(folder, columns):
    """Imitation's folder with other columns."""
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
def test_a_folder_of_another_shape_is_refused_and_nothing_changes(tmp_path, changes, problem):
    copy(tmp_path, {name: values for name, values in {**GOOD, **changes}.items() if values is not None})
    before = everything_in(tmp_path)
    with pytest.raises(problem):
        list(read_imitation_trajectories(tmp_path / "copy"))
    assert everything_in(tmp_path) == before


@settings(max_examples=60)
@given(st.data())
def test_a_file_that_was_cut_anywhere_is_refused(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("cut") / "copy"
    shutil.copytree(FIXTURE, folder)
    path = folder / "data-00000-of-00001.arrow"
    size = path.stat().st_size
    # Two places where one message ends and the next begins, or any other.
    os.truncate(path, data.draw(st.sampled_from([1232, size - 8]) | st.integers(0, size - 1)))
    with pytest.raises(InvalidFile):
        list(read_imitation_trajectories(folder))


@pytest.mark.parametrize(
    "state", [{}, [], {"_data_files": []}, {"_data_files": [{"filename": "../../secret"}]}, {"_data_files": [{}]}]
)
def test_a_state_that_makes_no_sense_or_leads_elsewhere_is_refused(tmp_path, state):
    shutil.copytree(FIXTURE, tmp_path / "copy")
    (tmp_path / "copy" / "state.json").write_text(json.dumps(state))
    with pytest.raises(InvalidFile, match=r"state\.json"):
        list(read_imitation_trajectories(tmp_path / "copy"))


def test_files_that_are_missing_are_named(tmp_path):
    with pytest.raises(MissingPart, match=r"state\.json"):
        list(read_imitation_trajectories(tmp_path))
    shutil.copytree(FIXTURE, tmp_path / "copy")
    (tmp_path / "copy" / "data-00000-of-00001.arrow").unlink()
    with pytest.raises(MissingPart, match="data-00000"):
        list(read_imitation_trajectories(tmp_path / "copy"))


def test_more_than_is_wanted_is_not_read():
    with pytest.raises(FileTooLarge):
        list(read_imitation_trajectories(FIXTURE, max_bytes=100))


def test_episodes_that_differ_leave_nothing(tmp_path):
    for episodes in ([], [*made_episodes([2]), *made_episodes([2], known=())]):
        with pytest.raises(ShapeError):
            write_imitation_trajectories(tmp_path / "out", episodes)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_there_is_not_written_over(tmp_path):
    (tmp_path / "mine").touch()
    with pytest.raises(AlreadyExists):
        write_imitation_trajectories(tmp_path, made_episodes([2]))
    assert everything_in(tmp_path) == {"mine": b""}
