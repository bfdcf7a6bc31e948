"""Replays are cut from a training as it goes, and no segment crosses into another episode."""

import numpy as np
import pytest

from mapt.policies import Rollout
from mapt.preferences.errors import AlreadyThere
from mapt.studies.errors import InvalidStudy
from mapt.studies.recording import EPISODES, Recording, episodes_path, places, record_replay
from mapt.studies.replay import Replay
from mapt.tasks import UnknownTask, make_task

# Two rollouts of 32 environments and 128 steps.
SHORT = Recording("HalfCheetah-2x3", policy_steps=8192, segment_steps=40, segments=30, seed=3)


def rollout_with_starts(*starts: tuple[int, int]) -> Rollout:
    length, n_envs = 20, 2
    episode_start = np.zeros((length, n_envs), dtype=bool)
    for step, env in starts:
        episode_start[step, env] = True
    fields = dict.fromkeys(Rollout.__dataclass_fields__, np.zeros((length, n_envs)))
    return Rollout(**{**fields, "episode_start": episode_start})


def test_no_segment_crosses_into_an_episode():
    rollout = rollout_with_starts((3, 0), (10, 1), (0, 1))
    found = places(rollout, 5, 100, np.random.default_rng(0))
    firsts = {(steps.start, env) for steps, env in found}
    assert firsts == {(first, env) for env in (0, 1) for first in (0, 5, 10, 15)} - {(0, 0)}


def test_as_many_places_are_drawn_as_are_wanted():
    rollout = rollout_with_starts()
    assert len(places(rollout, 5, 3, np.random.default_rng(0))) == 3
    assert places(rollout, 5, 0, np.random.default_rng(0)) == []
    assert places(rollout, 5, -2, np.random.default_rng(0)) == []
    assert places(rollout, 21, 4, np.random.default_rng(0)) == []


def test_a_replay_is_spread_over_the_training_and_its_states_are_the_simulators(tmp_path):
    seen: list[int] = []
    replay = record_replay(SHORT, tmp_path / "replay", lambda steps, _reward: seen.append(steps))
    assert seen == [4096, 8192]
    assert len(replay) == 30
    assert replay.mask.all()
    assert replay.origin["task"] == "HalfCheetah-2x3"
    task = make_task("HalfCheetah-2x3", 1)
    spec = task.spec
    task.close()
    assert replay.source.qpos([0]).shape == (1, 40, spec.nq)
    # Forward speed over a step of 0.05 s, less the cost of the actions: the reward of that very step.
    x, actions = replay.source.qpos(np.arange(30))[..., 0], replay.segments(np.arange(30)).actions
    speed = np.diff(x, axis=1) / spec.step_seconds
    cost = 0.1 * (actions.astype(float) ** 2).sum(axis=(2, 3))[:, :-1]
    np.testing.assert_allclose(replay.rewards[:, :-1], speed - cost, atol=1e-5)
    episodes = Replay.open(episodes_path(replay.path))
    assert episodes.rewards.shape == (EPISODES, spec.horizon_steps)
    assert episodes.mask.all()


def test_the_same_recording_gives_the_same_replay(tmp_path):
    short = Recording("HalfCheetah-2x3", policy_steps=4096, segment_steps=30, segments=12, seed=0)
    first, second = (record_replay(short, tmp_path / name) for name in "ab")
    assert first.fingerprint() == second.fingerprint()


def test_a_replay_is_never_written_over(tmp_path, replay):
    with pytest.raises(AlreadyThere):
        record_replay(SHORT, replay.path)


@pytest.mark.parametrize("changes", [{"segment_steps": 129}, {"segment_steps": 0}, {"segments": 0}])
def test_a_recording_out_of_range_is_refused(tmp_path, changes):
    with pytest.raises(InvalidStudy):
        record_replay(Recording(**{**{f: getattr(SHORT, f) for f in SHORT.__dataclass_fields__}, **changes}), tmp_path)


def test_an_unknown_task_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(UnknownTask):
        record_replay(Recording("Nothing", 4096, 40, 30, 0), tmp_path / "replay")
    assert not (tmp_path / "replay").exists()
