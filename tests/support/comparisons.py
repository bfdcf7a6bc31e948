"""Synthetic segments, comparisons and episodes, and assertions that two of them are equal."""

from pathlib import Path

import numpy as np

from mapt.preferences.dataset import SegmentArrays, SegmentSource
from mapt.preferences.formats.records import Comparisons, Episode, SegmentRecords, episodes_of


def made_records(
    n_segments: int,
    *,
    n_steps: int = 4,
    n_agents: int = 2,
    observation_dim: int = 3,
    action_dim: int = 2,
    discrete: bool = False,
    lengths: list[int] | None = None,
    known: tuple[str, ...] = ("rewards", "qpos", "qvel"),
    seed: int = 0,
) -> SegmentRecords:
    """Segments of normal noise; with `lengths`, zero-padded to the longest."""
    rng = np.random.default_rng(seed)
    steps = (n_segments, n_steps)
    mask = np.arange(n_steps) < np.array(lengths or [n_steps] * n_segments)[:, None]
    observations = rng.normal(size=(*steps, n_agents, observation_dim)).astype(np.float32)
    actions = rng.normal(size=(*steps, n_agents, action_dim)).astype(np.float32)
    if discrete:
        actions = np.eye(action_dim, dtype=np.float32)[rng.integers(action_dim, size=(*steps, n_agents))]
    observations[~mask], actions[~mask] = 0, 0
    extras = {
        name: np.where(mask.reshape(*steps, *[1] * len(shape)), rng.normal(size=(*steps, *shape)), 0.0)
        for name, shape in (("rewards", ()), ("qpos", (5,)), ("qvel", (4,)))
        if name in known
    }
    return SegmentRecords(SegmentArrays(observations, actions, mask), **extras)


def made_comparisons(labels: list[float], **dimensions: object) -> Comparisons:
    """One pair of new segments per label."""
    records = made_records(2 * len(labels), **dimensions)  # type: ignore[arg-type]
    pairs = np.arange(2 * len(labels)).reshape(-1, 2)
    return Comparisons(records, pairs, np.array(labels, dtype=np.float32))


def assert_same_segments(found: SegmentSource, expected: SegmentSource) -> None:
    """Assert bitwise equality, except for the amount of padding."""
    assert len(found) == len(expected)
    index = np.arange(len(found))
    one, other = found.take(index), expected.take(index)
    np.testing.assert_array_equal(one.mask.sum(axis=1), other.mask.sum(axis=1))
    np.testing.assert_array_equal(one.observations[one.mask], other.observations[other.mask])
    np.testing.assert_array_equal(one.actions[one.mask], other.actions[other.mask])


def everything_in(folder: Path) -> dict[str, bytes]:
    """The content of every file below a folder, to check that nothing changed."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def made_episodes(lengths: list[int], *, n_agents: int = 1, **dimensions: object) -> list[Episode]:
    """Episodes of normal noise."""
    records = made_records(
        len(lengths),
        n_steps=max(lengths),
        n_agents=n_agents,
        lengths=lengths,
        **dimensions,  # type: ignore[arg-type]
    )
    return list(episodes_of(records))


def assert_same_episodes(found: list[Episode], expected: list[Episode]) -> None:
    """Assert bitwise equality."""
    assert [len(episode) for episode in found] == [len(episode) for episode in expected]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.observations, other.observations)
        np.testing.assert_array_equal(one.actions, other.actions)
        assert one.extras().keys() == other.extras().keys()
        for name, values in other.extras().items():
            np.testing.assert_array_equal(one.extras()[name], values)
