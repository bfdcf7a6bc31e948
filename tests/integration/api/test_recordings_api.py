"""Recordings of policies over HTTP."""

import numpy as np

from accord.domain.ids import new_id
from accord.services import clip_views, publish, recordings
from accord.store.tables import RecordingRow
from support.api_in_thread import ApiServer
from support.sample_experiments import CLIP_BYTES, NQ, NV, create_sample


def record(api: ApiServer, experiment_id: str) -> list[str]:
    """Two recordings, of the untrained policy and of one trained on reward version 1. Returns their ids."""
    ids: list[str] = []
    with api.stores.database.transaction() as session:
        version = publish.publish(
            session, experiment_id, "rewards/1", label_watermark=0, label_count=0, policy_steps=0, metrics={}
        )
        for steps, version_id in ((0, None), (1000, version.id)):
            id, key = recordings.store_states(api.stores.blobs, experiment_id, np.zeros((20, NQ)), np.zeros((20, NV)))
            row = RecordingRow(
                id=id,
                experiment_id=experiment_id,
                policy_steps=steps,
                reward_version_id=version_id,
                length_steps=20,
                true_return=-1.5,
                blob_key=key,
            )
            recordings.add(session, row)
            ids.append(id)
    return ids


def test_recordings_are_listed_with_their_versions(api_per_database: ApiServer) -> None:
    api = api_per_database
    sample = create_sample(api.stores.database, api.stores.blobs)
    path = f"/api/v1/experiments/{sample.experiment.id}/recordings"
    assert api.researcher.get(path).json() == {"available": True, "items": []}
    ids = record(api, sample.experiment.id)
    found = api.researcher.get(path).json()["items"]
    assert [(each["id"], each["policy_steps"], each["reward_version"]) for each in found] == [
        (ids[0], 0, None),
        (ids[1], 1000, 1),
    ]
    # Steps of HalfCheetah take 0.05 s.
    assert {(each["frames"], each["seconds"], each["true_return"], tuple(each["rendered"])) for each in found} == {
        (20, 1.0, -1.5, ())
    }
    missing = api.researcher.get(f"/api/v1/experiments/{new_id('exp')}/recordings")
    assert (missing.status_code, missing.json()["error"]["code"]) == (404, "experiment_not_found")


def test_a_video_is_requested_once_and_served_when_it_is_rendered(api: ApiServer) -> None:
    sample = create_sample(api.stores.database, api.stores.blobs)
    recording = record(api, sample.experiment.id)[1]
    view = f"/api/v1/recordings/{recording}/views/follow"
    assert api.researcher.get(f"{view}.mp4").json()["error"]["code"] == "recording_not_found"
    for _ in range(2):
        response = api.researcher.put(view)
        assert (response.status_code, response.json()) == (200, {"status": "pending", "video_url": None})
    with api.stores.database.transaction() as session:
        job = clip_views.claim_pending(session, "worker", 60.0)
        assert job is not None
        assert (job.task, job.camera, job.shown_id) == ("HalfCheetah-6x1", "follow", recording)
        api.stores.blobs.put(f"{job.folder}/1.mp4", CLIP_BYTES)
        assert clip_views.finish(session, job, f"{job.folder}/1.mp4", len(CLIP_BYTES))
    ready = api.researcher.put(view).json()
    assert ready == {"status": "ready", "video_url": f"{view}.mp4"}
    whole = api.researcher.get(ready["video_url"])
    assert (whole.content, whole.headers["content-type"]) == (CLIP_BYTES, "video/mp4")
    part = api.researcher.get(ready["video_url"], headers={"Range": "bytes=0-9"})
    assert (part.status_code, part.content) == (206, CLIP_BYTES[:10])
    listed = api.researcher.get(f"/api/v1/experiments/{sample.experiment.id}/recordings").json()["items"]
    assert [each["rendered"] for each in listed] == [[], ["follow"]]


def test_unknown_camera_and_recording_are_refused(api: ApiServer) -> None:
    sample = create_sample(api.stores.database, api.stores.blobs)
    recording = record(api, sample.experiment.id)[0]
    assert api.researcher.put(f"/api/v1/recordings/{recording}/views/below").status_code == 422
    assert api.researcher.put("/api/v1/recordings/clp_1/views/top").status_code == 422
    missing = api.researcher.put(f"/api/v1/recordings/{new_id('rec')}/views/top")
    assert (missing.status_code, missing.json()["error"]["code"]) == (404, "recording_not_found")
