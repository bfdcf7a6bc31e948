"""Episodes that terminate early give segments of unequal length, which the whole training loop handles."""

import io
from typing import Any

import av
import pytest
from safetensors.numpy import load

from integration.workers.worker_harness import SingleThreadedRewardWorker, WorkerHarness

# An untrained walker falls after about fifteen steps.
WALKER: dict[str, Any] = {
    "task": "Walker2d-2x3",
    "segment_steps": 30,
    "total_steps": 1440,
    "policy": {"n_envs": 8, "rollout_steps": 60, "epochs": 1, "minibatches": 2},
}


def lengths(harness: WorkerHarness) -> dict[str, int]:
    """The number of steps of each segment, by its id."""
    return dict(harness.rows("SELECT id, length_steps FROM segments"))


@pytest.mark.slow
@pytest.mark.parametrize("selection", ["recent", "disagreement_k_center"])
def test_a_policy_learns_from_labels_on_segments_of_unequal_length(harness: WorkerHarness, selection: str) -> None:
    id = harness.create_experiment(**WALKER, query_selection=selection)
    harness.train(id)
    n_steps = set(lengths(harness).values())
    assert min(n_steps) < 15 < max(n_steps) <= 30
    reward = SingleThreadedRewardWorker(harness.context)
    while harness.rows("SELECT status FROM experiments") == [("running",)]:
        reward.work()
        [(n_open,)] = harness.rows("SELECT count(*) FROM queries WHERE status = 'open'")
        harness.label(id, n_open)
        harness.train(id)
    assert harness.rows("SELECT status FROM experiments") == [("finished",)]
    assert harness.rows("SELECT count(*) FROM labels WHERE value IS NOT NULL") == [(16,)]
    assert len(harness.curve(id, "learned_return")) == 3


def test_a_clip_has_as_many_frames_as_its_segment_has_steps(harness: WorkerHarness) -> None:
    id = harness.create_experiment(**WALKER, render_clips=True)
    harness.train(id)
    assert SingleThreadedRewardWorker(harness.context).work()
    harness.render_clips()
    clips = harness.rows("SELECT segment_id, blob_key, frames FROM clips WHERE status = 'ready'")
    steps = lengths(harness)
    assert clips
    assert {frames for _, _, frames in clips} == {steps[segment] for segment, _, _ in clips}
    for segment, key, _ in clips:
        with av.open(io.BytesIO(harness.context.blobs.read(key))) as container:
            assert sum(1 for _ in container.decode(video=0)) == steps[segment]


def test_short_segments_end_in_a_fall(harness: WorkerHarness) -> None:
    harness.train(harness.create_experiment(**WALKER))
    ends = [
        load(harness.context.blobs.read(key))["qpos"][-1, 1:3]
        for (key,) in harness.rows("SELECT blob_key FROM segments WHERE length_steps < 30")
    ]
    assert ends
    # The episode ends outside heights of 0.8 to 2.0 or beyond an angle of 1 radian. The last stored state, one step
    # earlier, is close to these bounds.
    assert all(height < 0.9 or height > 1.9 or abs(angle) > 0.8 for height, angle in ends)
