"""A segment's arrays over HTTP: for programs that judge or learn, never for labellers."""

import pytest
from safetensors.numpy import load

from accord.services.collect import blob_key
from support.api_in_thread import Served
from support.scenes import STEPS, Scene, scene


@pytest.fixture
def made(api: Served) -> Scene:
    return scene(api.stores.database, api.stores.blobs)


def path(made: Scene, index: int = 2) -> str:
    return f"/api/v1/segments/{made.segment_ids[index]}/arrays"


@pytest.mark.parametrize("role", ["teacher", "researcher", "admin"])
def test_programs_get_the_arrays_as_they_are_stored(api: Served, made: Scene, role: str) -> None:
    response = getattr(api, role).get(path(made))
    assert response.status_code == 200
    assert response.headers["content-type"] == "application/octet-stream"
    with api.stores.database.reading() as session:
        assert response.content == api.stores.blobs.read(blob_key(session, made.segment_ids[2]))
    arrays = load(response.content)
    assert set(arrays) == {"observations", "actions", "rewards", "qpos", "qvel"}
    assert arrays["rewards"].tolist() == [2.0] * STEPS


def test_a_labeller_gets_none_of_it_by_any_way(api: Served, made: Scene) -> None:
    for headers in ({}, {"If-None-Match": f'"{made.segment_ids[2]}"'}, {"Range": "bytes=0-10"}):
        response = api.labeller.get(path(made), headers=headers)
        assert (response.status_code, response.json()["error"]["code"]) == (403, "returns_hidden")


def test_a_labeller_does_not_learn_which_segments_there_are(api: Served, made: Scene) -> None:
    absent = f"/api/v1/segments/seg_{'0' * 24}/arrays"
    assert api.labeller.get(absent).json() == api.labeller.get(path(made)).json()


def test_nobody_gets_arrays_without_a_token(api: Served, made: Scene) -> None:
    assert api.anyone.get(path(made)).status_code == 401
    with api.client("wrong") as stranger:
        assert stranger.get(path(made)).status_code == 401


def test_arrays_never_change_and_may_be_kept(api: Served, made: Scene) -> None:
    first = api.teacher.get(path(made))
    assert "immutable" in first.headers["cache-control"]
    assert "private" in first.headers["cache-control"]
    again = api.teacher.get(path(made), headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    other = api.teacher.get(path(made, 3), headers={"If-None-Match": first.headers["etag"]})
    assert other.status_code == 200


@pytest.mark.parametrize(
    ("id", "status", "code"),
    [("seg_" + "0" * 24, 404, "segment_not_found"), ("qry_" + "0" * 24, 422, "invalid_id"), ("x", 422, "invalid_id")],
)
def test_segments_that_are_not_there_are_named(api: Served, id: str, status: int, code: str) -> None:
    response = api.teacher.get(f"/api/v1/segments/{id}/arrays")
    assert (response.status_code, response.json()["error"]["code"]) == (status, code)


def test_arrays_whose_file_was_lost_are_named(api: Served, made: Scene) -> None:
    with api.stores.database.reading() as session:
        key = blob_key(session, made.segment_ids[2])
    api.stores.blobs.delete(key)
    response = api.teacher.get(path(made))
    assert (response.status_code, response.json()["error"]["code"]) == (503, "blob_missing")
