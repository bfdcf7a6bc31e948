"""Clips over HTTP: whole, in ranges, and from the browser's cache."""

from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from sqlalchemy import text

from accord.api.video import ByteRange, parse_range
from accord.domain.enums import ClipCamera
from accord.domain.errors import ClipNotFound
from accord.domain.ids import new_id
from accord.services import clip_views, clips, deletion, experiments
from accord.store import deletions
from accord.store.blobs import open_blobs
from support.api_in_thread import ApiServer, run_api_server
from support.s3_server import S3Server
from support.sample_experiments import CLIP_BYTES, create_sample
from support.stores import Stores

SIZE = len(CLIP_BYTES)


@pytest.fixture
def clip(api: ApiServer) -> str:
    """The URL of a clip."""
    sample = create_sample(api.stores.database, api.stores.blobs)
    found = api.labeller.post(f"/api/v1/experiments/{sample.experiment.id}/queries/next").json()
    return found["items"][0]["left"]["clip_url"]


def test_whole_clip_is_sent_and_may_be_cached(api: ApiServer, clip: str) -> None:
    response = api.labeller.get(clip)
    assert (response.status_code, response.content) == (200, CLIP_BYTES)
    assert response.headers["content-type"] == "video/mp4"
    assert response.headers["accept-ranges"] == "bytes"
    assert "immutable" in response.headers["cache-control"]
    assert "private" in response.headers["cache-control"]
    again = api.labeller.get(clip, headers={"If-None-Match": response.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize(
    ("requested", "start", "stop"),
    [("bytes=0-0", 0, 1), ("bytes=10-19", 10, 20), ("bytes=100-", 100, SIZE), ("bytes=-5", SIZE - 5, SIZE)],
)
def test_range_of_a_clip_is_sent(api: ApiServer, clip: str, requested: str, start: int, stop: int) -> None:
    response = api.labeller.get(clip, headers={"Range": requested})
    assert (response.status_code, response.content) == (206, CLIP_BYTES[start:stop])
    assert response.headers["content-range"] == f"bytes {start}-{stop - 1}/{SIZE}"


def test_range_beyond_the_end_is_refused(api: ApiServer, clip: str) -> None:
    response = api.labeller.get(clip, headers={"Range": f"bytes={SIZE}-"})
    assert response.status_code == 416
    assert response.headers["content-range"] == f"bytes */{SIZE}"


def test_whole_clip_is_sent_if_if_range_does_not_match(api: ApiServer, clip: str) -> None:
    response = api.labeller.get(clip, headers={"Range": "bytes=0-9", "If-Range": '"another"'})
    assert (response.status_code, response.content) == (200, CLIP_BYTES)


def test_clips_require_sign_in(api: ApiServer, clip: str) -> None:
    assert api.anyone.get(clip).status_code == 401


def test_clip_without_its_file_is_a_503_error_and_rendered_again(api: ApiServer, clip: str) -> None:
    key = f"clips/{clip.rpartition('/')[2]}"
    api.stores.blobs.delete(key)
    response = api.labeller.get(clip)
    assert (response.status_code, response.json()["error"]["code"]) == (503, "blob_missing")
    with api.stores.database.transaction() as session:
        job = clips.claim_pending(session, "tests", 60.0)
    assert job is not None
    assert job.replaces == key
    api.stores.blobs.put(key, CLIP_BYTES[:-1])
    with api.stores.database.transaction() as session:
        clips.finish(session, job.clip_id, clips.StoredClip("0" * 64, key, SIZE - 1, 5, 0.25, 320, 240))
    assert api.labeller.get(clip, headers={"If-None-Match": f'"{job.clip_id}-{SIZE}"'}).content == CLIP_BYTES[:-1]


def test_a_pruned_clip_is_rendered_again(api: ApiServer, clip: str) -> None:
    with api.stores.database.transaction() as session:
        session.execute(text("UPDATE experiments SET status = 'finished'"))
        session.execute(text("UPDATE clips SET size_bytes = 0"))
    response = api.labeller.get(clip, headers={"Range": "bytes=0-"})
    assert (response.status_code, response.json()["error"]["code"]) == (503, "blob_missing")
    with api.stores.database.transaction() as session:
        assert clips.claim_pending(session, "tests", 60.0) is not None


@pytest.mark.parametrize("experiment_is_over", [False, True])
def test_a_view_without_its_file_is_rendered_again(api: ApiServer, clip: str, experiment_is_over: bool) -> None:
    clip_id = clip.rpartition("/")[2].removesuffix(".mp4")
    view = f"/api/v1/clips/{clip_id}/views/side"
    assert api.labeller.put(view).json()["status"] == "pending"
    with api.stores.database.transaction() as session:
        job = clip_views.claim_pending(session, "tests", 60.0)
        assert job is not None
        clip_views.finish(session, job, "clips/missing.mp4", 10)
        if experiment_is_over:
            session.execute(text("UPDATE experiments SET status = 'finished'"))
    assert api.labeller.get(f"{view}.mp4").json()["error"]["code"] == "blob_missing"
    assert api.labeller.put(view).json()["status"] == "pending"
    with api.stores.database.transaction() as session:
        again = clip_views.claim_pending(session, "tests", 60.0)
    assert again is not None
    assert (again.replaces, again.shown_id) == ("clips/missing.mp4", clip_id)


@pytest.mark.parametrize("headers", [{}, {"Range": "bytes=0-"}, {"Range": "bytes=-100"}])
def test_clip_of_the_wrong_size_is_a_503_error(api: ApiServer, clip: str, headers: dict[str, str]) -> None:
    key = f"clips/{clip.rpartition('/')[2]}"
    api.stores.blobs.delete(key)
    api.stores.blobs.put(key, CLIP_BYTES[:2])
    response = api.labeller.get(clip, headers=headers)
    assert (response.status_code, response.json()["error"]["code"]) == (503, "blob_damaged")


def test_still_of_a_clip_of_the_wrong_size_is_a_503_error(api: ApiServer, clip: str) -> None:
    key = f"clips/{clip.rpartition('/')[2]}"
    api.stores.blobs.delete(key)
    api.stores.blobs.put(key, CLIP_BYTES[:2])
    response = api.labeller.get(clip.replace(".mp4", ".jpg"))
    assert (response.status_code, response.json()["error"]["code"]) == (503, "blob_damaged")


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("", None),
        ("bytes=-", None),
        ("bytes=5-4", None),
        ("bytes=a-b", None),
        ("items=0-1", None),
        ("bytes=0-1,3-4", None),
        (f"bytes={'9' * 4300}-", None),
        (f"bytes=-{'9' * 4301}", None),
        ("bytes=0-999", ByteRange(0, 100)),
        ("bytes=99-99", ByteRange(99, 100)),
        ("bytes=100-", ByteRange(100, 100)),
        ("bytes=-0", ByteRange(100, 100)),
        ("bytes=-1000", ByteRange(0, 100)),
    ],
)
def test_range_headers_are_parsed_as_in_rfc_9110(header: str, expected: ByteRange | None) -> None:
    assert parse_range(header, 100) == expected


def test_view_is_requested_once_and_served_when_it_is_rendered(api: ApiServer, clip: str) -> None:
    view = clip.replace(".mp4", "/views/top")
    assert api.labeller.get(f"{view}.mp4").json()["error"]["code"] == "clip_not_found"
    for _ in range(2):
        response = api.labeller.put(view)
        assert (response.status_code, response.json()) == (200, {"status": "pending", "clip_url": None})
    api.stores.blobs.put("clips/view.mp4", CLIP_BYTES)
    with api.stores.database.transaction() as session:
        job = clip_views.claim_pending(session, "worker", 60.0)
        assert job is not None
        assert (job.task, job.camera) == ("HalfCheetah-6x1", "top")
        assert clip_views.claim_pending(session, "another", 60.0) is None
        clip_views.finish(session, job, "clips/view.mp4", SIZE)
    ready = api.labeller.put(view).json()
    assert ready == {"status": "ready", "clip_url": f"{view}.mp4"}
    whole = api.labeller.get(ready["clip_url"])
    part = api.labeller.get(ready["clip_url"], headers={"Range": "bytes=0-9"})
    assert (whole.content, part.status_code, part.content) == (CLIP_BYTES, 206, CLIP_BYTES[:10])


def test_unknown_camera_and_clip_are_refused(api: ApiServer, clip: str) -> None:
    assert api.labeller.put(clip.replace(".mp4", "/views/below")).status_code == 422
    missing = api.labeller.put(f"/api/v1/clips/{new_id('clp')}/views/top")
    assert (missing.status_code, missing.json()["error"]["code"]) == (404, "clip_not_found")


def test_views_of_deleted_experiments_are_deleted(api: ApiServer, clip: str) -> None:
    clip_id = clip.rsplit("/", maxsplit=1)[-1].removesuffix(".mp4")
    api.labeller.put(clip.replace(".mp4", "/views/top"))
    api.stores.blobs.put("clips/view.mp4", CLIP_BYTES)
    with api.stores.database.transaction() as session:
        job = clip_views.claim_pending(session, "worker", 60.0)
        assert job is not None
        clip_views.finish(session, job, "clips/view.mp4", SIZE)
        row = experiments.cancel(session, clips.get(session, clip_id).experiment_id)
        deleted, keys = deletion.delete(session, row.id, row.name, "Rosa")
        assert deletions.blob_keys(session, row.id).clips == []
    assert "clips/view.mp4" in keys
    with pytest.raises(ClipNotFound), api.stores.database.transaction() as session:
        clip_views.request(session, clip_id, ClipCamera.TOP)
    del deleted


def test_clips_in_s3_can_be_fetched_from_there(tmp_path: Path, sqlite: Stores, s3_server: S3Server) -> None:
    stores = replace(sqlite, blobs=open_blobs(s3_server.url("redirects")))
    sample = create_sample(stores.database, stores.blobs)
    with run_api_server(stores, tmp_path, clip_redirects=True) as api:
        found = api.labeller.post(f"/api/v1/experiments/{sample.experiment.id}/queries/next").json()
        url = found["items"][0]["left"]["clip_url"]
        assert api.anyone.get(url).status_code == 401
        redirect = api.labeller.get(url)
        assert redirect.status_code == 307
        assert redirect.headers["cache-control"] == "no-store"
        target = urlsplit(redirect.headers["location"])
        # without the token of the service
        assert httpx.get(redirect.headers["location"]).content == CLIP_BYTES
        policy = redirect.headers["content-security-policy"]
        assert f"connect-src 'self' {target.scheme}://{target.netloc}" in policy
        for blob in stores.blobs.stored():
            stores.blobs.delete(blob.key)
        assert api.labeller.get(url).json()["error"]["code"] == "blob_missing"
