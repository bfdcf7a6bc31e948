"""Clips over HTTP: whole, in ranges, and from the browser's cache."""

import pytest

from accord.api.routes.clips import ByteRange, parse_range
from support.api_in_thread import ApiServer
from support.sample_experiments import CLIP_BYTES, create_sample

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


def test_clip_without_its_file_is_a_503_error(api: ApiServer, clip: str) -> None:
    clip_id = clip.rpartition("/")[2]
    api.stores.blobs.delete(f"clips/{clip_id}")
    response = api.labeller.get(clip)
    assert (response.status_code, response.json()["error"]["code"]) == (503, "blob_missing")


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("", None),
        ("bytes=-", None),
        ("bytes=5-4", None),
        ("bytes=a-b", None),
        ("items=0-1", None),
        ("bytes=0-1,3-4", None),
        ("bytes=0-999", ByteRange(0, 100)),
        ("bytes=99-99", ByteRange(99, 100)),
        ("bytes=100-", ByteRange(100, 100)),
        ("bytes=-0", ByteRange(100, 100)),
        ("bytes=-1000", ByteRange(0, 100)),
    ],
)
def test_range_headers_are_parsed_as_in_rfc_9110(header: str, expected: ByteRange | None) -> None:
    assert parse_range(header, 100) == expected
