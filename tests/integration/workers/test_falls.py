"""Where episodes end early, segments are of unequal length, and the loop goes round with them."""

import io
from typing import Any

import av
import pytest
from safetensors.numpy import load

from integration.workers.workplace import SingleThreadedRewardWorker, Workplace

# An untrained walker falls after some fifteen steps.
WALKER: dict[str, Any] = {
    "task": "Walker2d-2x3",
    "segment_steps": 30,
    "total_steps": 1440,
    "policy": {"n_envs": 8, "rollout_steps": 60, "epochs": 1, "minibatches": 2},
}


def lengths(place: Workplace) -> dict[str, int]:
    return dict(place.rows("SELECT id, length_steps FROM segments"))


@pytest.mark.parametrize("selection", ["uniform", "disagreement_k_center"])
def test_a_policy_learns_from_labels_on_segments_of_unequal_length(place: Workplace, selection: str) -> None:
    id = place.begin(**WALKER, query_selection=selection)
    place.train(id)
    found = set(lengths(place).values())
    assert min(found) < 15 < max(found) <= 30
    reward = SingleThreadedRewardWorker(place.context)
    while place.rows("SELECT status FROM experiments") == [("running",)]:
        reward.work()
        [(n_open,)] = place.rows("SELECT count(*) FROM queries WHERE status = 'open'")
        place.label(id, n_open)
        place.train(id)
    assert place.rows("SELECT status FROM experiments") == [("finished",)]
    assert place.rows("SELECT count(*) FROM labels WHERE value IS NOT NULL") == [(16,)]
    assert len(place.curve(id, "learned_return")) == 3


def test_a_clip_ends_where_its_segment_does(place: Workplace) -> None:
    id = place.begin(**WALKER, render_clips=True)
    place.train(id)
    assert SingleThreadedRewardWorker(place.context).work()
    place.make_clips()
    clips = place.rows("SELECT segment_id, blob_key, frames FROM clips WHERE status = 'ready'")
    steps = lengths(place)
    assert clips
    assert {frames for _, _, frames in clips} == {steps[segment] for segment, _, _ in clips}
    for segment, key, _ in clips:
        with av.open(io.BytesIO(place.context.blobs.read(key))) as container:
            assert sum(1 for _ in container.decode(video=0)) == steps[segment]


def test_a_segment_that_ends_early_ends_in_a_fall(place: Workplace) -> None:
    place.train(place.begin(**WALKER))
    ends = [
        load(place.context.blobs.read(key))["qpos"][-1, 1:3]
        for (key,) in place.rows("SELECT blob_key FROM segments WHERE length_steps < 30")
    ]
    assert ends
    # The walker's own bounds: a height of 0.8 to 2.0, and a radian of leaning. A step before, it is nearly there.
    assert all(height < 0.9 or height > 1.9 or abs(leaning) > 0.8 for height, leaning in ends)
