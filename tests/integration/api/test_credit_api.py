"""Who sees what the reward model learned, and when."""

import pytest

from accord.domain.ids import new_id
from accord.services import credit
from accord.services.credit import Histograms, PairCredit, PredictedPair, SegmentCredit, VersionReport
from accord.store.tables import CreditRow, RewardVersionRow
from support.api_in_thread import ApiServer
from support.sample_experiments import AGENTS, STEPS, SampleExperiment, create_sample


def learned(server: ApiServer, **changes: object) -> SampleExperiment:
    """An experiment with one reward version."""
    sample = create_sample(server.stores.database, server.stores.blobs, **changes)  # type: ignore[arg-type]
    with server.stores.database.transaction() as session:
        session.add(
            RewardVersionRow(
                id=new_id("rwv"),
                experiment_id=sample.experiment.id,
                number=1,
                parent_id=None,
                label_watermark=0,
                label_count=0,
                policy_steps=0,
                blob_key="rewards/none.safetensors",
                metrics={},
            )
        )
    return sample


def answer_all(server: ApiServer) -> None:
    """Answer every request for a pair as a reward worker does."""
    segment = SegmentCredit(0.25, [[0.5] * STEPS] * AGENTS, [1 / STEPS] * STEPS, None)
    with server.stores.database.transaction() as session:
        for row in session.query(CreditRow).where(CreditRow.status == "pending"):
            credit.finish(session, row.id, PairCredit(0.75, [0.5, 0.9], [segment, segment]))


def code(response) -> str:
    return response.json()["error"]["code"]


def test_a_researcher_asks_and_gets_the_answer_with_true_rewards(api_per_database: ApiServer) -> None:
    sample = learned(api_per_database)
    path = f"/api/v1/queries/{sample.query_ids[0]}/credit"
    missing = api_per_database.researcher.get(path)
    assert (missing.status_code, code(missing)) == (404, "credit_not_found")
    asked = api_per_database.researcher.put(path).json()
    assert (asked["status"], asked["version"], asked["result"]) == ("pending", 1, None)
    assert api_per_database.researcher.put(path).json() == asked
    answer_all(api_per_database)
    found = api_per_database.researcher.get(path).json()
    assert found["status"] == "ready"
    assert found["result"]["probability"] == 0.75
    assert found["result"]["segments"][1]["rewards"] == [[0.5] * STEPS] * AGENTS
    # Segment i has the true reward i at each step.
    assert found["query"]["left"]["true_rewards"] == [0.0] * STEPS
    assert found["query"]["right"]["true_rewards"] == [1.0] * STEPS
    assert found["labels"] == []
    body = {"labels": [{"query_id": sample.query_ids[0], "label": 1.0}]}
    api_per_database.teacher.post(f"/api/v1/experiments/{sample.experiment.id}/labels", json=body).raise_for_status()
    assert api_per_database.researcher.get(path).json()["labels"] == [1.0]


def test_a_labeller_sees_nothing_by_default(api: ApiServer) -> None:
    sample = learned(api)
    query = sample.query_ids[0]
    api.labeller.post(f"/api/v1/experiments/{sample.experiment.id}/queries/next")
    api.labeller.put(f"/api/v1/queries/{query}/label", json={"label": 1.0}).raise_for_status()
    for response in (
        api.labeller.put(f"/api/v1/queries/{query}/credit"),
        api.teacher.get(f"/api/v1/queries/{query}/credit"),
    ):
        assert (response.status_code, code(response)) == (403, "credit_hidden")


def test_with_show_credit_a_labeller_sees_it_after_the_label_and_never_true_rewards(api: ApiServer) -> None:
    sample = learned(api, show_credit=True)
    query = sample.query_ids[0]
    path = f"/api/v1/queries/{query}/credit"
    api.labeller.post(f"/api/v1/experiments/{sample.experiment.id}/queries/next")
    assert code(api.labeller.put(path)) == "credit_hidden"
    # A skip is no label: the pair can still be labelled.
    api.labeller.put(f"/api/v1/queries/{query}/label", json={"label": None}).raise_for_status()
    assert code(api.labeller.put(path)) == "credit_hidden"
    api.labeller.put(f"/api/v1/queries/{query}/label", json={"label": 1.0}).raise_for_status()
    assert api.labeller.put(path).status_code == 200
    answer_all(api)
    found = api.labeller.get(path).json()
    assert found["result"]["probability"] == 0.75
    assert found["labels"] == []
    assert {found["query"][side][name] for side in ("left", "right") for name in ("true_rewards", "true_return")} == {
        None
    }
    api.labeller.delete(f"/api/v1/queries/{query}/label").raise_for_status()
    assert code(api.labeller.get(path)) == "credit_hidden"


def test_reports_are_for_researchers(api: ApiServer) -> None:
    sample = learned(api, show_credit=True)
    path = f"/api/v1/experiments/{sample.experiment.id}/reward-versions/1/report"
    assert api.labeller.put(path).status_code == 403
    assert api.teacher.get(path).status_code == 403
    assert code(api.researcher.get(path)) == "credit_not_found"
    assert api.researcher.put(path).json()["status"] == "pending"
    assert api.researcher.get(path).json()["result"] is None


def test_a_report_shows_pairs_on_the_sides_that_the_researcher_saw(api_per_database: ApiServer) -> None:
    api, sample = api_per_database, learned(api_per_database)
    path = f"/api/v1/experiments/{sample.experiment.id}"
    shown = api.researcher.post(f"{path}/queries/next", params={"count": 4}).json()["items"]
    report = f"{path}/reward-versions/1/report"
    api.researcher.put(report)
    pairs = [PredictedPair(each["id"], each["number"], 0.75, None, 1.0, True) for each in shown]
    histograms = Histograms([0.0, 1.0], [[1]], [1], [None], None)
    with api.stores.database.transaction() as session:
        (row,) = session.query(CreditRow)
        credit.finish(session, row.id, VersionReport(pairs, [], 0, histograms, 1, 1))
    seen = {each["id"]: each["left"]["index"] for each in shown}
    for client, expected in ((api.researcher, seen), (api.admin, dict.fromkeys(seen, 0))):
        found = client.get(report).json()["result"]["pairs"]
        assert {each["query_id"]: each["left_segment"] for each in found} == expected


def test_opposite_labels_are_listed_until_a_researcher_decides(api_per_database: ApiServer) -> None:
    api, sample = api_per_database, learned(api_per_database, labels_per_pair=2, overlap_share=1.0)
    query = sample.query_ids[0]
    report = f"/api/v1/experiments/{sample.experiment.id}/reward-versions/1/report"
    asked = api.researcher.put(report).json()["status"], api.researcher.put(f"/api/v1/queries/{query}/credit").json()
    assert asked[0] == asked[1]["status"] == "pending"
    histograms = Histograms([0.0, 1.0], [[1]], [1], [None], None)
    with api.stores.database.transaction() as session:
        (row,) = session.query(CreditRow).where(CreditRow.query_id.is_(None))
        pairs = [PredictedPair(query, 1, 0.75, None, None, trained_on=False)]
        credit.finish(session, row.id, VersionReport(pairs, [], 0, histograms, 1, 1))

    def labels() -> list[list[float]]:
        of_pair = api.researcher.get(f"/api/v1/queries/{query}/credit").json()["labels"]
        return [of_pair, api.researcher.get(report).json()["result"]["pairs"][0]["labels"]]

    assert labels() == [[], []]
    for client, value in ((api.labeller, 1.0), (api.teacher, 0.0)):
        client.post(f"/api/v1/experiments/{sample.experiment.id}/queries/next")
        body = {"label": value, "order": "segments"}
        client.put(f"/api/v1/queries/{query}/label", json=body).raise_for_status()
    assert labels() == [[1.0, 0.0]] * 2
    decision = {"label": 0.0, "order": "segments", "final": True}
    api.researcher.put(f"/api/v1/queries/{query}/label", json=decision).raise_for_status()
    assert labels() == [[0.0]] * 2


@pytest.mark.parametrize(
    "path", ["queries/{query}/credit?version=2", "experiments/{experiment}/reward-versions/2/report"]
)
def test_a_version_that_does_not_exist_is_not_found(api: ApiServer, path: str) -> None:
    sample = learned(api)
    url = path.format(query=sample.query_ids[0], experiment=sample.experiment.id)
    response = api.researcher.put(f"/api/v1/{url}")
    assert (response.status_code, code(response)) == (404, "reward_version_not_found")
