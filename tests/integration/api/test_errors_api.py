"""Errors: status, stable code, message and invalid field."""

import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest
from sqlalchemy import event

from accord.api.errors import status_of
from accord.domain import errors as domain_errors
from accord.domain.enums import Role
from accord.domain.errors import AccordError
from accord.domain.ids import new_id
from support.api_in_thread import ApiServer, run_api_server
from support.sample_experiments import create_sample
from support.stores import Stores

NEW = {"name": "one", "task": "HalfCheetah-6x1"}


def assert_error(response: httpx.Response, status: int, code: str, *parts: str, field: str | None = None) -> None:
    """Check the body of an error: its message contains `parts`, and its details name the invalid `field`."""
    assert response.status_code == status, response.text
    body = response.json()
    assert set(body) == {"error"}
    assert set(body["error"]) == {"code", "message", "details"}
    assert body["error"]["code"] == code
    message = body["error"]["message"]
    assert len(message) > 20
    for part in parts:
        assert part in message
    if field is not None:
        assert body["error"]["details"][0]["field"] == field


def test_label_other_than_0_half_and_1_is_refused(api: ApiServer) -> None:
    sample = create_sample(api.stores.database, api.stores.blobs)
    path = f"/api/v1/queries/{sample.query_ids[0]}/label"
    assert_error(api.teacher.put(path, json={"label": 0.7}), 422, "invalid_label", "0.7", "0.5 (equal)")
    nan = api.teacher.put(path, content=b'{"label": NaN}', headers={"Content-Type": "application/json"})
    assert_error(nan, 422, "invalid_label", "nan")


@pytest.mark.parametrize("label", ["1", True, [1], {}])
def test_label_that_is_not_a_number_is_refused(api: ApiServer, label: object) -> None:
    path = f"/api/v1/queries/{new_id('qry')}/label"
    assert_error(api.teacher.put(path, json={"label": label}), 422, "invalid_request", field="label")


def test_label_for_a_closed_query_is_refused(api_per_database: ApiServer) -> None:
    sample = create_sample(api_per_database.stores.database, api_per_database.stores.blobs)
    path = f"/api/v1/queries/{sample.query_ids[0]}/label"
    assert api_per_database.teacher.put(path, json={"label": 1}).status_code == 201
    assert_error(api_per_database.researcher.put(path, json={"label": 1}), 409, "query_closed", "next query")


def test_label_for_a_query_leased_to_another_user_is_refused(api_per_database: ApiServer) -> None:
    sample = create_sample(api_per_database.stores.database, api_per_database.stores.blobs)
    api_per_database.labeller.post(f"/api/v1/experiments/{sample.experiment.id}/queries/next")
    path = f"/api/v1/queries/{sample.query_ids[0]}/label"
    assert_error(api_per_database.teacher.put(path, json={"label": 1}), 410, "lease_lost", "next query")


def test_label_for_a_cancelled_experiment_is_refused(api: ApiServer) -> None:
    sample = create_sample(api.stores.database, api.stores.blobs)
    assert api.researcher.post(f"/api/v1/experiments/{sample.experiment.id}/cancel").status_code == 200
    path = f"/api/v1/queries/{sample.query_ids[0]}/label"
    assert_error(api.teacher.put(path, json={"label": 1}), 409, "experiment_not_active", "cancelled")


def test_undo_without_a_label_is_refused(api: ApiServer) -> None:
    sample = create_sample(api.stores.database, api.stores.blobs)
    assert_error(api.teacher.delete(f"/api/v1/queries/{sample.query_ids[0]}/label"), 404, "label_not_found")


def test_segments_longer_than_an_episode_are_refused(api: ApiServer) -> None:
    long = {"segment_steps": 2000, "policy": {"rollout_steps": 2000}}
    response = api.researcher.post("/api/v1/experiments", json=NEW | long)
    assert_error(response, 422, "invalid_experiment", "1000", field="segment_steps")


@pytest.mark.parametrize(
    ("policy", "field"),
    [
        ({"n_environments": 4}, "policy.n_environments"),
        ({"algorithm": "ppo"}, "policy.algorithm"),
        ({"clip": 0}, "policy.clip"),
        ({"n_envs": "many"}, "policy.n_envs"),
        ({"hidden": [32, "32"]}, "policy.hidden"),
        ({"rollout_steps": 25, "minibatches": 1}, "policy.rollout_steps"),
    ],
)
def test_error_for_an_invalid_policy_setting_names_it(api: ApiServer, policy: dict[str, object], field: str) -> None:
    response = api.researcher.post("/api/v1/experiments", json=NEW | {"segment_steps": 50, "policy": policy})
    assert_error(response, 422, "invalid_experiment", field, field=field)


def test_training_that_does_not_fit_in_memory_is_refused(sqlite: Stores, tmp_path: Path) -> None:
    large = {"policy": {"n_envs": 4096}}
    with run_api_server(sqlite, tmp_path, max_training_bytes=2 * 10**9) as api:
        response = api.researcher.post("/api/v1/experiments", json=NEW | large)
        assert_error(response, 422, "invalid_experiment", "policy.n_envs", "2.0 GB", field="policy.n_envs")
        assert api.researcher.post("/api/v1/experiments", json=NEW).status_code == 201
    with run_api_server(sqlite, tmp_path) as api:
        response = api.researcher.post("/api/v1/experiments", json=NEW | {"policy": {"n_envs": 65_536}})
        assert_error(response, 422, "invalid_experiment", field="policy.n_envs")


def test_error_for_an_unknown_task_lists_the_known_tasks(api: ApiServer) -> None:
    response = api.researcher.post("/api/v1/experiments", json=NEW | {"task": "Walker"})
    assert_error(response, 422, "unknown_task", "'Walker'", "HalfCheetah-6x1", field="task")


@pytest.mark.parametrize(
    "wrong",
    [
        {"total_steps": 0},
        {"total_steps": 10**13},
        {"total_steps": "many"},
        {"total_step": 5},
        {"initial_labels": 900},
        {"seed": -1},
        {"control_share": 2},
        {"pacing": "fast"},
    ],
)
def test_error_for_an_invalid_setting_names_it(api: ApiServer, wrong: dict[str, object]) -> None:
    [field] = wrong
    response = api.researcher.post("/api/v1/experiments", json=NEW | wrong)
    assert_error(response, 422, "invalid_experiment", field, field=field)


def test_experiment_without_a_task_is_refused(api: ApiServer) -> None:
    assert_error(
        api.researcher.post("/api/v1/experiments", json={"name": "x"}), 422, "invalid_experiment", field="task"
    )


@pytest.mark.parametrize(
    ("setting", "known"),
    [
        ("reward_preset", ("small", "paper")),
        ("reward_model", ("MAPT", "MAPT-paper", "MAPT-TPA", "MA-Transformer")),
        ("policy_reward", ("value", "attended", "weighted")),
        ("query_selection", ("uniform", "recent", "disagreement", "entropy", "k_center")),
        ("label_schedule", ("power", "constant", "decaying")),
    ],
)
def test_error_for_an_unknown_choice_lists_the_known_choices(
    api: ApiServer, setting: str, known: tuple[str, ...]
) -> None:
    response = api.researcher.post("/api/v1/experiments", json=NEW | {setting: "huge"})
    assert_error(response, 422, "invalid_experiment", *known, field=setting)


def test_duplicate_experiment_name_is_refused(api: ApiServer) -> None:
    assert api.researcher.post("/api/v1/experiments", json=NEW).status_code == 201
    assert_error(api.researcher.post("/api/v1/experiments", json=NEW), 409, "name_taken", field="name")


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "/api/v1/experiments/{}"),
        ("POST", "/api/v1/experiments/{}/pause"),
        ("GET", "/api/v1/experiments/{}/metrics"),
        ("GET", "/api/v1/experiments/{}/reward-versions"),
        ("GET", "/api/v1/experiments/{}/events"),
        ("POST", "/api/v1/experiments/{}/queries/next"),
        ("PUT", "/api/v1/queries/{}/lease"),
        ("DELETE", "/api/v1/queries/{}/lease"),
        ("DELETE", "/api/v1/queries/{}/label"),
        ("GET", "/api/v1/clips/{}.mp4"),
    ],
)
def test_malformed_id_is_422_and_absent_id_is_404(api: ApiServer, method: str, path: str) -> None:
    kind = {"experiments": "exp", "queries": "qry", "clips": "clp"}[path.split("/")[3]]
    for bad in ("1", f"{kind}_", f"{kind}_{'g' * 24}", new_id("zzz"), "%00", f"{kind}_{'0' * 24}%0a"):
        assert_error(api.admin.request(method, path.format(bad)), 422, "invalid_id", kind)
    name = {"exp": "experiment", "qry": "query", "clp": "clip"}[kind]
    assert_error(api.admin.request(method, path.format(new_id(kind))), 404, f"{name}_not_found", name)


def test_invalid_cursor_is_refused(api: ApiServer) -> None:
    assert_error(api.admin.get("/api/v1/experiments", params={"cursor": "x"}), 422, "invalid_id")


@pytest.mark.parametrize("token", [None, "", "wrong", "ü", "x" * 5000])
def test_missing_or_wrong_token_is_refused(api: ApiServer, token: str | None) -> None:
    headers = {} if token is None else {"Authorization": f"Bearer {token}".strip().encode()}
    for method, path in (("GET", "/api/v1/me"), ("POST", "/api/v1/users"), ("GET", "/api/v1/experiments")):
        json_body = {"name": "x", "role": "admin"} if method == "POST" else None
        response = api.anyone.request(method, path, headers=headers, json=json_body)
        assert_error(response, 401, "unauthenticated")
        assert response.headers["WWW-Authenticate"].startswith("Bearer")


def test_true_returns_are_refused_to_labellers(api: ApiServer) -> None:
    sample = create_sample(api.stores.database, api.stores.blobs)
    path = f"/api/v1/experiments/{sample.experiment.id}/queries/next"
    assert_error(api.labeller.post(path, params={"returns": True}), 403, "returns_hidden", "labellers")


def test_unknown_paths_are_404_and_unknown_methods_405(api: ApiServer) -> None:
    for path in ("/api", "/api/", "/api/v1", "/api/v2/me", "/api/v1/nothing", "/api/v1/me/"):
        assert_error(api.admin.get(path), 404, "not_found", "/api/docs")
    response = api.admin.delete("/api/v1/me")
    assert_error(response, 405, "method_not_allowed")
    assert response.headers["Allow"] == "GET"
    assert_error(api.admin.post("/elsewhere"), 405, "method_not_allowed")


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"null", b"\xff\xfe", b'{"label": 1', b'{"label": 1e999}'])
def test_malformed_body_is_refused(api: ApiServer, content: bytes) -> None:
    response = api.teacher.put(
        f"/api/v1/queries/{new_id('qry')}/label", content=content, headers={"Content-Type": "application/json"}
    )
    assert response.status_code == 422
    assert response.json()["error"]["code"] in {"invalid_request", "invalid_label"}


@pytest.mark.parametrize("name", ["nul\u0000", "half \ud800", "two\nlines", " "])
def test_name_that_cannot_be_stored_is_refused(api_per_database: ApiServer, name: str) -> None:
    content = json.dumps({"name": name, "task": "HalfCheetah-6x1"}).encode()
    response = api_per_database.researcher.post(
        "/api/v1/experiments", content=content, headers={"Content-Type": "application/json"}
    )
    assert response.status_code == 422
    assert response.json()["error"]["code"] in {"invalid", "invalid_request"}


def test_unusual_description_of_a_teacher_is_stored_or_refused_with_422(api_per_database: ApiServer) -> None:
    sample = create_sample(api_per_database.stores.database, api_per_database.stores.blobs)
    for query_id, teacher in zip(
        sample.query_ids,
        ('{"a": "nul \\u0000"}', '{"\\ud800": 1}', '{"n": 123456789012345678901234567890}'),
        strict=False,
    ):
        response = api_per_database.teacher.put(
            f"/api/v1/queries/{query_id}/label",
            content=f'{{"label": 1, "teacher": {teacher}}}'.encode(),
            headers={"Content-Type": "application/json"},
        )
        assert response.status_code in {201, 422}, response.text
    response = api_per_database.teacher.put(
        f"/api/v1/queries/{sample.query_ids[3]}/label",
        content=b'{"label": 1, "teacher": {"beta": Infinity}}',
        headers={"Content-Type": "application/json"},
    )
    assert_error(response, 422, "invalid", "teacher")


def chunks(size_bytes: int) -> Iterator[bytes]:
    chunk = b" " * 50_000
    for _ in range(size_bytes // len(chunk)):
        yield chunk


def test_body_above_the_size_limit_is_refused(api: ApiServer) -> None:
    path = f"/api/v1/queries/{new_id('qry')}/label"
    headers = {"Content-Type": "application/json"}
    for content in (b"{" + b" " * 3_000_000 + b"}", chunks(3_000_000)):
        assert_error(api.teacher.put(path, content=content, headers=headers), 413, "body_too_large", "smaller")
    # The server responds without reading the rest of a streamed body.
    with api.client(api.tokens[Role.TEACHER]) as client:
        request = client.build_request("PUT", path, content=chunks(100_000_000), headers=headers)
        # It may close the connection while the client is still sending.
        with suppress(httpx.WriteError):
            assert_error(client.send(request), 413, "body_too_large")
    assert api.anyone.get("/api/v1/health").status_code == 200


def test_body_at_the_size_limit_is_accepted(sqlite: Stores, tmp_path: Path) -> None:
    with run_api_server(sqlite, tmp_path, max_body_bytes=1000) as api:
        path, body = f"/api/v1/queries/{new_id('qry')}/label", b'{"label": 1}'
        headers = {"Content-Type": "application/json"}
        at_limit = api.teacher.put(path, content=body.ljust(1000), headers=headers)
        assert_error(at_limit, 404, "query_not_found")
        assert_error(api.teacher.put(path, content=body.ljust(1001), headers=headers), 413, "body_too_large", "1000")


def test_unexpected_error_hides_its_message_and_gives_the_id_in_the_log(
    api: ApiServer, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_connection: object) -> None:
        raise ZeroDivisionError("a secret")

    event.listen(api.stores.database.engine, "commit", fail)
    response = api.admin.post("/api/v1/users", json={"name": "x", "role": "labeller"})
    event.remove(api.stores.database.engine, "commit", fail)
    assert_error(response, 500, "internal", response.headers["X-Request-ID"])
    assert "secret" not in response.text
    (details,) = response.json()["error"]["details"]
    assert details["id"] in caplog.text


def test_label_is_not_acknowledged_if_the_commit_fails(api_per_database: ApiServer) -> None:
    sample = create_sample(api_per_database.stores.database, api_per_database.stores.blobs)
    path = f"/api/v1/queries/{sample.query_ids[0]}/label"

    def fail(_connection: object) -> None:
        raise ZeroDivisionError

    event.listen(api_per_database.stores.database.engine, "commit", fail)
    response = api_per_database.teacher.put(path, json={"label": 1})
    event.remove(api_per_database.stores.database.engine, "commit", fail)
    assert_error(response, 500, "internal")
    # A new connection, because the server closes a connection after an unexpected error.
    with api_per_database.client(api_per_database.tokens[Role.TEACHER]) as teacher:
        again = teacher.put(path, json={"label": 1})
    assert (again.status_code, again.json()["revision"]) == (201, 1)


def test_unreadable_database_is_a_503_error(api: ApiServer) -> None:
    path = Path(api.stores.database_url.removeprefix("sqlite:///"))
    api.stores.database.close()
    path.unlink()
    path.write_bytes(b"not a database" * 1000)
    for companion in (f"{path}-wal", f"{path}-shm"):
        Path(companion).unlink(missing_ok=True)
    response = api.admin.get("/api/v1/me")
    assert_error(response, 503, "database_unreachable")
    assert response.headers["Retry-After"]


def test_every_error_has_a_status_and_a_unique_code() -> None:
    classes = [
        each for each in vars(domain_errors).values() if isinstance(each, type) and issubclass(each, AccordError)
    ]
    assert len(classes) > 20
    codes = [each.code for each in classes]
    assert len(codes) == len(set(codes))
    for each in classes:
        if each is not AccordError:
            assert status_of(each.__new__(each)) != 500, each
