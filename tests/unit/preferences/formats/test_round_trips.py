"""Readers read back what writers write: discrete and continuous actions, any number of agents."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapt.errors import InvalidFile, NotOneHot
from mapt.preferences.formats.d4rl import read_d4rl, write_d4rl
from mapt.preferences.formats.imitation import (
    read_imitation,
    read_imitation_trajectories,
    write_imitation,
    write_imitation_trajectories,
)
from mapt.preferences.formats.minari import read_minari, write_minari
from mapt.preferences.formats.offline_labels import LabelFiles, read_offline_labels, write_offline_labels
from mapt.preferences.formats.records import Comparisons, Episode, SegmentRecords, episodes_of
from mapt.preferences.formats.reference import read_reference, write_reference
from mapt.preferences.formats.tables import LabelRow, PreferenceTables, QueryRow, SegmentRow, TableWriter
from support.comparisons import assert_same_episodes, assert_same_segments, made_comparisons, made_episodes

N_ACTIONS = 3


def through_imitation(path: Path, comparisons: Comparisons, *, discrete: bool) -> Comparisons:
    write_imitation(path, comparisons, discrete=discrete)
    return read_imitation(path, n_actions=N_ACTIONS if discrete else None)


def through_reference(path: Path, comparisons: Comparisons, *, discrete: bool) -> Comparisons:
    write_reference(path, comparisons.dataset(), discrete=discrete)
    return read_reference(path, n_actions=N_ACTIONS if discrete else None)


def through_offline_labels(path: Path, comparisons: Comparisons, *, discrete: bool) -> Comparisons:
    write_offline_labels(path, comparisons)
    n_steps = comparisons.records.segments.n_steps
    return read_offline_labels(path / "trajectories.hdf5", LabelFiles.find(path), n_steps)


def through_tables(path: Path, comparisons: Comparisons, *, discrete: bool) -> Comparisons:
    records = comparisons.records
    with TableWriter(path, records.layout(discrete=discrete), about={}) as tables:
        tables.add_segments([SegmentRow(str(index)) for index in range(len(records))], records)
        tables.add_queries(
            QueryRow(str(index), str(first), str(second))
            for index, (first, second) in enumerate(comparisons.pairs.tolist())
        )
        tables.add_labels(
            LabelRow(str(index), "somebody", "label", label) for index, label in enumerate(comparisons.labels.tolist())
        )
    found = PreferenceTables.open(path).load(path.with_name("segments"))
    everything = found.segments.take(np.arange(len(found.segments)))
    return Comparisons(SegmentRecords(everything), found.pairs, found.labels)


def through_trajectories(path: Path, episodes: list[Episode], *, discrete: bool) -> list[Episode]:
    write_imitation_trajectories(path, episodes, discrete=discrete)
    return list(read_imitation_trajectories(path, n_actions=N_ACTIONS if discrete else None))


def through_minari(path: Path, episodes: list[Episode], *, discrete: bool) -> list[Episode]:
    write_minari(path, episodes, dataset_id="test/replay-v0", discrete=discrete)
    return list(read_minari(path, n_actions=N_ACTIONS if discrete else None))


def through_d4rl(path: Path, episodes: list[Episode], *, discrete: bool) -> list[Episode]:
    write_d4rl(path, episodes)
    return list(read_d4rl(path))


@pytest.mark.parametrize("through", [through_imitation, through_reference, through_offline_labels, through_tables])
@settings(max_examples=15)
@given(
    st.lists(st.sampled_from([0.0, 0.5, 1.0]), min_size=1, max_size=4),
    st.integers(1, 3),
    st.booleans(),
    st.integers(0, 99),
)
def test_comparisons_are_read_back_equal(
    tmp_path_factory, through: Callable[..., Comparisons], labels, n_agents, discrete, seed
):
    path = tmp_path_factory.mktemp("comparisons") / "file"
    made = made_comparisons(labels, n_agents=n_agents, action_dim=N_ACTIONS, discrete=discrete, seed=seed)
    found = through(path, made, discrete=discrete)
    assert found.labels.tolist() == labels
    order = made.pairs.T.reshape(-1)
    assert_same_segments(found.records.segments.take(found.pairs.T.reshape(-1)), made.records.segments.take(order))


@pytest.mark.parametrize("known", [("rewards", "qpos", "qvel"), ("rewards", "qpos")])
@settings(max_examples=15)
@given(st.lists(st.tuples(st.integers(1, 4), st.integers(1, 4)), min_size=1, max_size=3), st.integers(0, 99))
def test_states_are_read_back_equal_from_imitation(tmp_path_factory, known, lengths, seed):
    steps = [length for pair in lengths for length in pair]
    made = made_comparisons([1.0] * len(lengths), lengths=steps, n_steps=max(steps), known=known, seed=seed)
    found = through_imitation(tmp_path_factory.mktemp("states") / "file", made, discrete=False)
    order = made.pairs.T.reshape(-1)
    assert_same_episodes(list(episodes_of(found.records)), list(episodes_of(made.records.take(order))))


@pytest.mark.parametrize(
    ("through", "known"),
    [
        (through_trajectories, ("rewards",)),
        (through_minari, ("rewards", "qpos", "qvel")),
        (through_d4rl, ("rewards", "qpos", "qvel")),
    ],
)
@settings(max_examples=15)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=3), st.integers(1, 3), st.booleans(), st.integers(0, 99))
def test_episodes_are_read_back_equal(
    tmp_path_factory, through: Callable[..., list[Episode]], known, lengths, n_agents, discrete, seed
):
    path = tmp_path_factory.mktemp("episodes") / "file"
    made = made_episodes(lengths, n_agents=n_agents, action_dim=N_ACTIONS, discrete=discrete, known=known, seed=seed)
    assert_same_episodes(through(path, made, discrete=discrete), made)


@pytest.mark.parametrize("through", [through_trajectories, through_minari])
def test_one_hot_actions_of_earlier_versions_are_read(tmp_path, through):
    made = made_episodes([4], n_agents=2, action_dim=N_ACTIONS, discrete=True, known=("rewards",))
    through(tmp_path / "file", made, discrete=False)
    read = read_imitation_trajectories if through is through_trajectories else read_minari
    assert_same_episodes(list(read(tmp_path / "file", n_actions=N_ACTIONS)), made)


def test_one_hot_preferences_of_earlier_versions_are_read(tmp_path):
    made = made_comparisons([1.0], action_dim=N_ACTIONS, discrete=True)
    write_imitation(tmp_path / "file", made)
    found = read_imitation(tmp_path / "file", n_actions=N_ACTIONS)
    assert_same_segments(found.records.segments, made.records.segments)
    write_imitation(tmp_path / "continuous", made_comparisons([1.0], action_dim=N_ACTIONS))
    with pytest.raises(InvalidFile, match="invalid action"):
        read_imitation(tmp_path / "continuous", n_actions=N_ACTIONS)


def test_continuous_actions_are_not_written_as_indices(tmp_path):
    with pytest.raises(NotOneHot):
        write_imitation(tmp_path / "file", made_comparisons([1.0]), discrete=True)
    episodes = made_episodes([4])
    with pytest.raises(NotOneHot):
        write_imitation_trajectories(tmp_path / "file", episodes, discrete=True)
    with pytest.raises(NotOneHot):
        write_minari(tmp_path / "file", episodes, dataset_id="x", discrete=True)
    assert list(tmp_path.iterdir()) == []
    assert np.isfinite(episodes[0].actions).all()
