"""Tasks without MuJoCo states: they draw their own clips, or say in a sentence why there are none."""

import io
import os
from pathlib import Path

import av
import numpy as np
import pytest
from safetensors.numpy import load

from accord.services import experiments
from accord.services.collect import replayed_clip_key
from accord.workers.policy_worker import PolicyWorker
from accord.workers.replayed_clips import RolloutReplay, even_size
from integration.workers.workplace import SingleThreadedRewardWorker, Workplace
from mapt.policies import Learner, PolicyConfig
from mapt.preferences.segments import StepRange
from mapt.tasks import make_task
from support import light_tasks

OPTIONS = {"render_clips": True, "policy": {"n_envs": 3, "rollout_steps": 50, "epochs": 1, "minibatches": 1}}


@pytest.fixture(autouse=True)
def known_tasks(short_episodes: None, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [os.environ["MAPT_TASKS"], light_tasks.ENVIRONMENT["MAPT_TASKS"]]
    monkeypatch.setenv("MAPT_TASKS", os.pathsep.join(files))


def assert_shows(clip: bytes, levels: np.ndarray) -> None:
    """A frame of the light for each of the levels (T,)."""
    with av.open(io.BytesIO(clip)) as container:
        shown = np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
    assert shown.shape == (len(levels), 46, 64, 3)
    expected = np.array([light_tasks.light(level) for level in levels])
    assert np.abs(shown.mean(axis=(1, 2, 3)) - expected).max() < 8  # a level is 28


def collect(place: Workplace, task: str, **changes: object) -> str:
    """An experiment whose policy has handed its first segments in."""
    id = place.begin(task=task, **{**OPTIONS, **changes})
    with place.training(id) as run:
        run.step()
    return id


def test_a_clip_shows_each_state_in_which_an_action_was_taken(place: Workplace) -> None:
    collect(place, "Buttons-2")
    segments = place.rows("SELECT blob_key FROM segments")
    assert len(segments) > 8
    shown_levels = set()
    for (key,) in segments:
        arrays = load(place.context.blobs.read(key))
        levels = np.round(arrays["observations"][:, 0, 0] * light_tasks.LEVELS).astype(int)
        assert_shows(place.context.blobs.read(replayed_clip_key(key)), levels)
        shown_levels |= set(levels.tolist())
    assert len(shown_levels) > 4


def test_queries_of_a_task_that_draws_itself_open_with_its_clips(place: Workplace) -> None:
    collect(place, "Buttons-2")
    assert SingleThreadedRewardWorker(place.context).work()
    place.make_clips()
    assert place.rows("SELECT DISTINCT status FROM queries") == [("open",)]
    clips = place.rows("SELECT frames, seconds, width, height, size_bytes, blob_key FROM clips")
    for frames, seconds, width, height, size_bytes, key in clips:
        assert (frames, seconds, width, height) == (10, pytest.approx(1.0), 64, 46)
        assert len(place.context.blobs.read(key)) == size_bytes


def test_a_later_rollout_is_drawn_from_the_middle_of_its_episodes(place: Workplace) -> None:
    # An episode has 30 steps and a rollout 50: the second rollout begins where no episode does.
    task = make_task("Buttons-2", 3)
    learner = Learner(task, PolicyConfig(n_envs=3, rollout_steps=50, minibatches=1, n_threads=1))
    learner.collect()
    before = task.snapshot()
    rollout = learner.collect()
    assert not rollout.episode_start[0].any()
    places, keys = [(0, 0, 10), (1, 12, 22), (2, 43, 50)], [f"segments/{name}.safetensors" for name in "abc"]
    RolloutReplay(task, before, rollout).store_clips(place.context.blobs, [StepRange(*each) for each in places], keys)
    for (env, first, end), key in zip(places, keys, strict=True):
        levels = np.round(rollout.observations[first:end, env, 0, 0] * light_tasks.LEVELS).astype(int)
        assert_shows(place.context.blobs.read(replayed_clip_key(key)), levels)


def test_nothing_is_drawn_where_programs_alone_label(place: Workplace) -> None:
    collect(place, "Buttons-2", render_clips=False)
    [(key,), *_] = place.rows("SELECT blob_key FROM segments")
    assert not (place.home / "blobs" / replayed_clip_key(key)).exists()


@pytest.mark.parametrize(
    ("task", "words"),
    [("BlindButtons-2", "render_mode='rgb_array'"), ("VaryingButtons-2", "is not deterministic given its seed")],
)
def test_a_task_that_cannot_be_drawn_ends_its_experiment_with_a_sentence(
    place: Workplace, task: str, words: str
) -> None:
    id = place.begin(task=task, **OPTIONS)
    assert PolicyWorker(place.context).work()
    with place.database.reading() as session:
        row = experiments.get(session, id)
        assert row.status == "failed"
        assert task in row.phase_detail
        assert words in row.phase_detail
    assert place.rows("SELECT count(*) FROM segments") == [(0,)]


def test_a_clip_that_was_lost_fails_its_query_and_no_other(place: Workplace) -> None:
    collect(place, "Buttons-2")
    assert SingleThreadedRewardWorker(place.context).work()
    [(lost, key), *_] = place.rows(
        "SELECT s.id, s.blob_key FROM segments s JOIN clips c ON c.segment_id = s.id ORDER BY s.id"
    )
    Path(place.home / "blobs" / replayed_clip_key(key)).unlink()
    place.make_clips()
    assert place.rows("SELECT status FROM clips WHERE segment_id = ?", lost) == [("failed",)]
    [(detail,)] = place.rows("SELECT detail FROM clips WHERE segment_id = ?", lost)
    assert "stored no clip" in detail
    others = "SELECT DISTINCT status FROM queries WHERE NOT ? IN (segment_0_id, segment_1_id)"
    assert place.rows(others, lost) == [("open",)]


@pytest.mark.parametrize(("shape", "expected"), [((4, 6), (4, 6)), ((5, 6), (6, 6)), ((5, 7), (6, 8))])
def test_pictures_of_any_size_become_even(shape: tuple[int, int], expected: tuple[int, int]) -> None:
    picture = np.arange(shape[0] * shape[1] * 3, dtype=np.uint8).reshape(*shape, 3)
    made = even_size(picture)
    assert made.shape == (*expected, 3)
    np.testing.assert_array_equal(made[: shape[0], : shape[1]], picture)
