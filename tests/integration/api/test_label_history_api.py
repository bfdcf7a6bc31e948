"""A labeller's own labels, and the table of queries, labels and revisions for researchers."""

import csv
import io
from pathlib import Path
from typing import Any

import httpx
import imageio.v3 as iio
import numpy as np
import pyarrow.parquet as pq
import pytest
from sqlalchemy import update

from accord.store.tables import ClipRow
from mapt.rendering.encode import write_clip
from mapt.rendering.settings import RenderSettings
from support.api_in_thread import ApiServer
from support.sample_experiments import SampleExperiment, create_sample


@pytest.fixture
def labelled(api_per_database: ApiServer) -> SampleExperiment:
    """The labeller answers left, equal and skip, and changes the first answer. The teacher labels the fourth query."""
    sample = create_sample(api_per_database.stores.database, api_per_database.stores.blobs)
    one, two, three, four = sample.query_ids
    path = f"/api/v1/experiments/{sample.experiment.id}"
    labeller = api_per_database.labeller
    assert len(labeller.post(f"{path}/queries/next", params={"count": 3}).json()["items"]) == 3
    for query_id, value in ((one, 1.0), (two, 0.5), (three, None), (one, 0.0)):
        body = {"label": value, "order": "shown", "response_seconds": 2.0}
        assert labeller.put(f"/api/v1/queries/{query_id}/label", json=body).status_code == 201
    batch = {"labels": [{"query_id": four, "label": 1.0, "teacher": {"name": "oracle"}}]}
    assert api_per_database.teacher.post(f"{path}/labels", json=batch).json()["items"][0]["ok"]
    return sample


def store_video(api: ApiServer, clip_id: str, content: bytes) -> None:
    """Give a sample's clip, which is not a video, this content."""
    key = f"clips/{clip_id}.mp4"
    api.stores.blobs.delete(key)
    api.stores.blobs.put(key, content)
    with api.stores.database.transaction() as session:
        session.execute(update(ClipRow).where(ClipRow.id == clip_id).values(size_bytes=len(content)))


def get(client: httpx.Client, sample: SampleExperiment, path: str, **query: Any) -> dict[str, Any]:
    response = client.get(f"/api/v1/experiments/{sample.experiment.id}/{path}", params=query)
    assert response.status_code == 200, response.text
    return response.json()


def test_own_labels_are_listed_newest_first_with_their_counts(
    api_per_database: ApiServer, labelled: SampleExperiment
) -> None:
    one, two, three, four = labelled.query_ids
    found = get(api_per_database.labeller, labelled, "labels/mine")
    assert [item["query"]["id"] for item in found["items"]] == [one, three, two]
    assert (found["labels"], found["skips"], found["next_before"]) == (2, 1, None)
    newest = found["items"][0]
    # The right clip was preferred, on the sides that the labeller saw.
    assert newest["label"] == (1.0 if newest["query"]["right"]["index"] == 0 else 0.0)
    assert newest["revision"] == 4
    page = get(api_per_database.labeller, labelled, "labels/mine", limit=2)
    rest = get(api_per_database.labeller, labelled, "labels/mine", limit=2, before=page["next_before"])
    assert [item["query"]["id"] for item in page["items"] + rest["items"]] == [one, three, two]
    api_per_database.labeller.delete(f"/api/v1/queries/{one}/label", params={"replaces": 4}).raise_for_status()
    assert get(api_per_database.labeller, labelled, "labels/mine")["labels"] == 1
    own = get(api_per_database.teacher, labelled, "labels/mine")["items"]
    assert [item["query"]["id"] for item in own] == [four]


def test_an_answer_to_a_label_changed_elsewhere_is_a_conflict(
    api_per_database: ApiServer, labelled: SampleExperiment
) -> None:
    path = f"/api/v1/queries/{labelled.query_ids[0]}/label"
    refused = api_per_database.labeller.put(path, json={"label": 0.5, "order": "shown", "replaces": 1})
    assert (refused.status_code, refused.json()["error"]["code"]) == (409, "label_changed")
    changed = api_per_database.labeller.put(path, json={"label": 0.5, "order": "shown", "replaces": 4})
    assert changed.status_code == 201


def test_researchers_filter_queries_by_their_labels(api_per_database: ApiServer, labelled: SampleExperiment) -> None:
    one, two, three, four = labelled.query_ids
    with api_per_database.client(labelled.owner_token) as researcher:

        def numbers(**query: Any) -> list[int]:
            return [item["number"] for item in get(researcher, labelled, "queries", **query)["items"]]

        page = get(researcher, labelled, "queries")
        assert [item["id"] for item in page["items"]] == [four, three, two, one]
        (label,) = page["items"][3]["labels"]
        assert [each["revision"] for each in label["revisions"]] == [1, 4]
        assert label["revisions"][1]["label"] == 1.0 - label["revisions"][0]["label"]
        labeller = label["user_id"]
        assert {author["labels"] for author in page["authors"]} == {1, 2}
        assert numbers(status="open") == [3]
        assert numbers(user=labeller) == [3, 2, 1]
        assert (numbers(label="skip"), numbers(label="0.5")) == ([3], [2])
        assert numbers(user=labeller, label="1") == ([1] if label["revisions"][1]["label"] == 1.0 else [])
        assert (numbers(changed=True), numbers(changed=False)) == ([1], [4, 3, 2])
        assert (numbers(limit=3), numbers(limit=3, before=2)) == ([4, 3, 2], [1])

        beyond = {"before": 2**63}
        refused = researcher.get(f"/api/v1/experiments/{labelled.experiment.id}/queries", params=beyond)
        assert (refused.status_code, refused.json()["error"]["code"]) == (422, "invalid_request")

        text = researcher.get(f"/api/v1/experiments/{labelled.experiment.id}/queries.csv").text
        rows = list(csv.DictReader(io.StringIO(text)))
        assert [(row["query_number"], row["revision"], row["current"]) for row in rows] == [
            ("1", "1", "False"),
            ("1", "4", "True"),
            ("2", "2", "True"),
            ("3", "3", "True"),
            ("4", "5", "True"),
        ]
        assert rows[4]["teacher"] == '{"name": "oracle"}'
        assert (rows[3]["state"], rows[3]["label"]) == ("skip", "")

        content = researcher.get(f"/api/v1/experiments/{labelled.experiment.id}/queries.parquet").content
        table = pq.read_table(io.BytesIO(content))
        assert table.column_names == list(rows[0])
        typed = table.to_pylist()
        assert [(row["query_id"], row["label"], row["current"]) for row in typed] == [
            (row["query_id"], float(row["label"]) if row["label"] else None, row["current"] == "True") for row in rows
        ]
        assert [row["created_at"].isoformat() for row in typed] == [row["created_at"] for row in rows]
        only_skips = researcher.get(
            f"/api/v1/experiments/{labelled.experiment.id}/queries.parquet", params={"label": "skip"}
        )
        assert pq.read_table(io.BytesIO(only_skips.content)).column("state").to_pylist() == ["skip"]


def test_downloads_have_a_row_for_a_query_without_labels_and_run_no_formula(api: ApiServer) -> None:
    sample = create_sample(api.stores.database, api.stores.blobs, queries=1)
    address = f"/api/v1/experiments/{sample.experiment.id}/queries"
    gold = {"label": 1, "practice": False, "explanation": "=1+1"}
    api.researcher.put(f"/api/v1/queries/{sample.query_ids[0]}/gold", json=gold).raise_for_status()
    (row,) = csv.DictReader(io.StringIO(api.researcher.get(f"{address}.csv").text))
    assert (row["gold"], row["explanation"], row["state"], row["label"]) == ("1.0", "'=1+1", "", "")
    (typed,) = pq.read_table(io.BytesIO(api.researcher.get(f"{address}.parquet").content)).to_pylist()
    assert (typed["gold"], typed["explanation"], typed["state"], typed["label"]) == (1.0, "=1+1", None, None)


def test_labellers_and_teachers_do_not_read_the_labels_of_others(
    api_per_database: ApiServer, labelled: SampleExperiment
) -> None:
    for client in (api_per_database.labeller, api_per_database.teacher):
        for path in ("queries", "queries.csv", "queries.parquet"):
            response = client.get(f"/api/v1/experiments/{labelled.experiment.id}/{path}")
            assert (response.status_code, response.json()["error"]["code"]) == (403, "forbidden")


def test_a_still_shows_the_middle_of_a_clip(api: ApiServer, tmp_path: Path) -> None:
    sample = create_sample(api.stores.database, api.stores.blobs, queries=1)
    frames = [np.full((96, 128, 3), 20 * number, dtype=np.uint8) for number in range(10)]
    clip = write_clip(frames, tmp_path / "clip.mp4", RenderSettings(width=128, height=96))
    (query,) = api.labeller.post(f"/api/v1/experiments/{sample.experiment.id}/queries/next").json()["items"]
    path = query["left"]["thumbnail_url"]
    store_video(api, Path(path).stem, clip.path.read_bytes())
    still = api.labeller.get(path)
    assert (still.status_code, still.headers["content-type"]) == (200, "image/jpeg")
    image = iio.imread(still.content, extension=".jpg")
    assert image.shape == (120, 160, 3)
    assert abs(image.mean() - 100) < 8  # frame 5, the key frame in the middle
    assert api.labeller.get(path, headers={"If-None-Match": still.headers["etag"]}).status_code == 304
    with api.client(None) as stranger:
        assert stranger.get(path).status_code == 401


def test_a_clip_is_also_served_as_a_gif_of_the_same_length(api: ApiServer, tmp_path: Path) -> None:
    sample = create_sample(api.stores.database, api.stores.blobs, queries=1)
    frames = [np.full((96, 128, 3), 20 * number, dtype=np.uint8) for number in range(10)]
    # 125 frames per second, as of a walker: every third one is shown.
    clip = write_clip(frames, tmp_path / "clip.mp4", RenderSettings(width=128, height=96, frame_rate_hz=125))
    (query,) = api.labeller.post(f"/api/v1/experiments/{sample.experiment.id}/queries/next").json()["items"]
    path = query["left"]["clip_url"].replace(".mp4", ".gif")
    assert api.labeller.get(path).status_code == 404  # the sample's clip is not a video
    store_video(api, Path(path).stem, clip.path.read_bytes())
    response = api.labeller.get(path)
    assert (response.status_code, response.headers["content-type"]) == (200, "image/gif")
    shown = iio.imread(response.content, extension=".gif")
    assert shown.shape[:3] == (4, 240, 320)
    np.testing.assert_allclose(shown.mean(axis=(1, 2, 3)), [0, 60, 120, 180], atol=8)
    assert iio.immeta(response.content, extension=".gif")["loop"] == 0


def test_every_edit_of_the_instructions_is_a_revision_that_labels_name(api_per_database: ApiServer) -> None:
    api = api_per_database
    sample = create_sample(api.stores.database, api.stores.blobs)
    path = f"/api/v1/experiments/{sample.experiment.id}"
    for text, number in (("Run **fast**.", 2), ("Run **fast**.", 2), ("Run far.", 3)):
        changed = api.researcher.patch(path, json={"instructions": text}).json()
        assert (changed["instructions"], changed["instructions_revision"]) == (text, number)
    listed = api.labeller.get(f"{path}/instructions").json()
    assert [(each["number"], each["text"], each["author"]) for each in listed] == [
        (1, sample.experiment.instructions, ""),
        (2, "Run **fast**.", "the researcher"),
        (3, "Run far.", "the researcher"),
    ]
    queries = api.labeller.post(f"{path}/queries/next", params={"count": 3}).json()["items"]
    for query, revision in zip(queries, (2, 9, None), strict=True):
        body = {"label": 1, "instructions_revision": revision}
        assert api.labeller.put(f"/api/v1/queries/{query['id']}/label", json=body).status_code == 201
    api.labeller.put(f"/api/v1/queries/{queries[0]['id']}/label", json={"label": 0, "instructions_revision": 3})
    table = api.researcher.get(f"{path}/queries").json()["items"]
    found = {query["id"]: query["labels"][0]["revisions"] for query in table if query["labels"]}
    given = [[each["instructions_revision"] for each in found[query["id"]]] for query in queries]
    assert given == [[2, 3], [None], [None]], "a number that does not exist costs no label"
    rows = list(csv.DictReader(io.StringIO(api.researcher.get(f"{path}/queries.csv").text)))
    assert [row["instructions_revision"] for row in rows if row["query_id"] == queries[0]["id"]] == ["2", "3"]
