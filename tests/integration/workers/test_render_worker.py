import io
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest
from safetensors.numpy import load, save

from accord.domain.enums import WorkerRole
from accord.workers.render_worker import RenderWorker
from integration.workers.workplace import SingleThreadedRewardWorker, Workplace, workplace


@pytest.fixture
def drawing(tmp_path: Path) -> Iterator[tuple[Workplace, RenderWorker]]:
    """Queries that wait for their clips, and who makes them."""
    with workplace(tmp_path, WorkerRole.RENDER) as place:
        id = place.begin(render_clips=True)
        with place.training(id) as run:
            run.step()
        assert SingleThreadedRewardWorker(place.context).work()
        worker = RenderWorker(place.context)
        yield place, worker
        worker.close()


def drain(worker: RenderWorker) -> None:
    while worker.work():
        pass


def test_every_query_opens_once_both_clips_are_there(drawing):
    place, worker = drawing
    assert place.rows("SELECT DISTINCT status FROM queries") == [("rendering",)]
    drain(worker)
    assert place.rows("SELECT DISTINCT status FROM queries") == [("open",)]
    clips = place.rows("SELECT blob_key, frames, seconds, size_bytes, width, height FROM clips")
    assert len(clips) == len(place.rows("SELECT id FROM segments"))
    for blob_key, frames, seconds, size_bytes, width, height in clips:
        content = place.context.blobs.read(blob_key)
        assert len(content) == size_bytes
        with av.open(io.BytesIO(content)) as container:
            shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert len(shown) == frames == 10
        assert shown[0].shape == (height, width, 3)
        assert seconds == pytest.approx(0.5)


def test_the_query_offered_first_is_made_first(drawing):
    place, worker = drawing
    for _ in range(2):
        worker.work()
    assert place.rows("SELECT number FROM queries WHERE status = 'open'") == [(1,)]


def test_states_that_cannot_be_drawn_fail_their_queries_and_no_others(drawing):
    place, worker = drawing
    [(segment_id, blob_key)] = place.rows("SELECT id, blob_key FROM segments LIMIT 1")
    path = place.home / "blobs" / blob_key
    path.write_bytes(save(load(path.read_bytes()) | {"qpos": np.zeros((10, 3))}))
    drain(worker)
    [(status, attempts, detail)] = place.rows(
        "SELECT status, attempts, detail FROM clips WHERE segment_id = ?", segment_id
    )
    assert (status, attempts) == ("failed", 3)
    assert "(T,9)" in detail
    with_it = "? IN (segment_0_id, segment_1_id)"
    assert place.rows(f"SELECT DISTINCT status FROM queries WHERE {with_it}", segment_id) == [("failed",)]
    assert place.rows(f"SELECT DISTINCT status FROM queries WHERE NOT {with_it}", segment_id) == [("open",)]
