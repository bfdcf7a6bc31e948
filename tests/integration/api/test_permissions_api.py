"""Who may do what: every operation with every role, and users who see only some experiments."""

import json
from typing import Any

import httpx
import pytest

from accord.api.openapi import document
from accord.domain.enums import Role
from accord.domain.ids import new_id
from support.api_in_thread import ApiServer
from support.sample_experiments import SampleExperiment, create_sample

EVERYONE = frozenset(Role)
NOT_LABELLERS = EVERYONE - {Role.LABELLER}
RESEARCHERS = frozenset({Role.RESEARCHER, Role.ADMIN})
ADMINS = frozenset({Role.ADMIN})

#: operation -> the roles that may use it
ALLOWED: dict[str, frozenset[Role]] = {
    "GET /me": EVERYONE,
    "POST /sign-out": EVERYONE,
    "GET /tokens": EVERYONE,
    "POST /tokens": EVERYONE,
    "DELETE /tokens/{token_id}": EVERYONE,
    "GET /tasks": EVERYONE,
    "GET /workers": EVERYONE,
    "GET /experiments": EVERYONE,
    "GET /experiments/{experiment_id}": EVERYONE,
    "GET /experiments/{experiment_id}/events": EVERYONE,
    "GET /experiments/{experiment_id}/instructions": EVERYONE,
    "GET /experiments/{experiment_id}/metrics": EVERYONE,
    "GET /experiments/{experiment_id}/reward-versions": EVERYONE,
    "GET /experiments/{experiment_id}/labels/mine": EVERYONE,
    "POST /experiments/{experiment_id}/queries/next": EVERYONE,
    "PUT /queries/{query_id}/lease": EVERYONE,
    "DELETE /queries/{query_id}/lease": EVERYONE,
    "PUT /queries/{query_id}/label": EVERYONE,
    "DELETE /queries/{query_id}/label": EVERYONE,
    "POST /experiments/{experiment_id}/practice": EVERYONE,
    "PUT /queries/{query_id}/practice": EVERYONE,
    # A labeller gets an answer only for a query that they have labelled.
    "PUT /queries/{query_id}/credit": EVERYONE,
    "GET /queries/{query_id}/credit": EVERYONE,
    "GET /clips/{clip_id}.mp4": EVERYONE,
    "GET /clips/{clip_id}.jpg": EVERYONE,
    "GET /clips/{clip_id}.gif": EVERYONE,
    "PUT /clips/{clip_id}/views/{camera}": EVERYONE,
    "GET /clips/{clip_id}/views/{camera}.mp4": EVERYONE,
    "GET /segments/{segment_id}/arrays": NOT_LABELLERS,
    "POST /experiments/{experiment_id}/labels": NOT_LABELLERS,
    "POST /experiments": RESEARCHERS,
    "PATCH /experiments/{experiment_id}": RESEARCHERS,
    "DELETE /experiments/{experiment_id}": RESEARCHERS,
    "POST /experiments/{experiment_id}/pause": RESEARCHERS,
    "POST /experiments/{experiment_id}/resume": RESEARCHERS,
    "POST /experiments/{experiment_id}/cancel": RESEARCHERS,
    "POST /experiments/{experiment_id}/archive": RESEARCHERS,
    "POST /experiments/{experiment_id}/restore": RESEARCHERS,
    "GET /experiments/{experiment_id}/costs": RESEARCHERS,
    "GET /experiments/{experiment_id}/shares": RESEARCHERS,
    "POST /experiments/{experiment_id}/shares": RESEARCHERS,
    "DELETE /experiments/{experiment_id}/shares/{share_id}": RESEARCHERS,
    "POST /experiments/import": RESEARCHERS,
    "POST /policies": RESEARCHERS,
    "GET /experiments/{experiment_id}/export": RESEARCHERS,
    "GET /experiments/{experiment_id}/reward-versions/{number}/weights": RESEARCHERS,
    "GET /experiments/{experiment_id}/reward-versions/{number}/card": RESEARCHERS,
    "GET /experiments/{experiment_id}/policy": RESEARCHERS,
    "GET /experiments/{experiment_id}/queries": RESEARCHERS,
    "GET /experiments/{experiment_id}/queries.csv": RESEARCHERS,
    "GET /experiments/{experiment_id}/queries.parquet": RESEARCHERS,
    "PUT /experiments/{experiment_id}/reward-versions/{number}/report": RESEARCHERS,
    "GET /experiments/{experiment_id}/reward-versions/{number}/report": RESEARCHERS,
    "GET /experiments/{experiment_id}/recordings": RESEARCHERS,
    "PUT /recordings/{recording_id}/views/{camera}": RESEARCHERS,
    "GET /recordings/{recording_id}/views/{camera}.mp4": RESEARCHERS,
    "PATCH /experiments/{experiment_id}/labels": RESEARCHERS,
    "PATCH /experiments/{experiment_id}/labellers/{user_id}": RESEARCHERS,
    "GET /experiments/{experiment_id}/quality": RESEARCHERS,
    "GET /experiments/{experiment_id}/reliability": RESEARCHERS,
    "PUT /queries/{query_id}/gold": RESEARCHERS,
    "DELETE /queries/{query_id}/gold": RESEARCHERS,
    "GET /deletions": RESEARCHERS,
    "GET /users": ADMINS,
    "POST /users": ADMINS,
    "PATCH /users/{user_id}": ADMINS,
    "DELETE /users/{user_id}": ADMINS,
    "POST /users/{user_id}/link": ADMINS,
    "POST /users/{user_id}/token": ADMINS,
    "POST /users/{user_id}/revoke": ADMINS,
    "GET /audit": ADMINS,
    "GET /webhooks": ADMINS,
    "POST /webhooks": ADMINS,
    "DELETE /webhooks/{webhook_id}": ADMINS,
    "POST /webhooks/{webhook_id}/test": ADMINS,
    "GET /webhooks/{webhook_id}/deliveries": ADMINS,
    "GET /invitations": ADMINS,
    "POST /invitations": ADMINS,
    "DELETE /invitations/{invitation_id}": ADMINS,
}
#: need no account
PUBLIC = {
    "GET /health",
    "GET /ready",
    "GET /join/{token}",
    "POST /join/{token}",
    "GET /sign-in/{token}",
    "POST /sign-in/{token}",
    "GET /shared",
    "GET /oidc",
    "GET /oidc/start",
    "GET /oidc/callback",
    "GET /oidc/sign-out",
}
#: what an operation needs to be valid
BODIES: dict[str, dict[str, Any]] = {
    "POST /experiments": {"name": "one", "task": "no such task"},
    "PATCH /experiments/{experiment_id}": {"instructions": "Run."},
    "PUT /queries/{query_id}/label": {"label": 1},
    "PUT /queries/{query_id}/practice": {"label": 1},
    "POST /experiments/{experiment_id}/labels": {"labels": [{"query_id": new_id("qry"), "label": 1}]},
    "PATCH /experiments/{experiment_id}/labels": {"label_ids": [new_id("lbl")], "excluded": True},
    "PATCH /experiments/{experiment_id}/labellers/{user_id}": {"paused": True},
    "PUT /queries/{query_id}/gold": {"label": 1},
    "POST /users": {"name": "x", "role": "labeller"},
    "PATCH /users/{user_id}": {"role": "labeller"},
    "POST /experiments/{experiment_id}/shares": {"days": 1},
    "POST /invitations": {"experiment_id": new_id("exp")},
    "POST /tokens": {"name": "mine"},
    "POST /webhooks": {"url": "https://example.com/", "events": ["labels.due"]},
}
PARAMETERS = {"DELETE /experiments/{experiment_id}": {"name": "one"}, "POST /experiments/import": {"name": "one"}}
#: refused as invalid after the role is checked
INVALID = {"POST /experiments", "POST /experiments/import", "POST /policies"}


def request(client: httpx.Client, operation: str, **ids: str) -> httpx.Response:
    """Send a valid request; objects that `ids` does not name do not exist."""
    absent = {"experiment_id": "exp", "query_id": "qry", "clip_id": "clp", "segment_id": "seg", "user_id": "usr"}
    absent |= {"invitation_id": "inv", "share_id": "shr", "recording_id": "rec", "token_id": "tok", "webhook_id": "whk"}
    method, path = operation.split()
    filled = f"/api/v1{path}".format(
        number=1, camera="top", **{name: new_id(kind) for name, kind in absent.items()} | ids
    )
    return client.request(method, filled, json=BODIES.get(operation), params=PARAMETERS.get(operation))


def test_the_table_has_every_operation() -> None:
    operations = {
        f"{method.upper()} {path.removeprefix('/api/v1')}"
        for path, methods in json.loads(document())["paths"].items()
        for method in methods
    }
    assert operations - PUBLIC == set(ALLOWED)


def test_every_operation_is_refused_to_all_other_roles(api: ApiServer) -> None:
    found: dict[str, frozenset[Role]] = {}
    # Signing out, which deletes the token of the request, comes last.
    for operation in sorted(ALLOWED, key=lambda operation: operation == "POST /sign-out"):
        accepted: list[Role] = []
        for role in Role:
            response = request(getattr(api, role.value), operation)
            if response.status_code != 403:
                assert response.status_code not in {401, 422} or operation in INVALID, response.text
                accepted.append(role)
        found[operation] = frozenset(accepted)
    assert found == ALLOWED


def test_every_operation_is_refused_without_a_token(api: ApiServer) -> None:
    for operation in ALLOWED:
        assert request(api.anyone, operation).status_code == 401, operation


#: operations on objects of experiments that labellers or teachers may use
OF_EXPERIMENTS = [
    operation
    for operation, roles in ALLOWED.items()
    if Role.TEACHER in roles and any(f"{{{kind}_id}}" in operation for kind in ("experiment", "clip", "segment"))
]


def restricted(api: ApiServer, role: Role, *experiment_ids: str) -> tuple[str, str]:
    """Id and token of a new user who sees only these experiments."""
    access = {"all_experiments": False, "experiment_ids": experiment_ids}
    made = api.admin.post("/api/v1/users", json={"name": new_id("usr"), "role": role, "access": access}).json()
    return made["id"], made["token"]


def ids_of(api: ApiServer, sample: SampleExperiment) -> dict[str, str]:
    """Existing objects of an experiment."""
    query = api.admin.post(f"/api/v1/experiments/{sample.experiment.id}/queries/next").json()["items"][0]
    api.admin.delete(f"/api/v1/queries/{query['id']}/lease")
    return {
        "experiment_id": sample.experiment.id,
        "query_id": query["id"],
        "clip_id": query["left"]["clip_url"].removeprefix("/api/v1/clips/").removesuffix(".mp4"),
        "segment_id": sample.segment_ids[0],
    }


def test_hidden_experiments_do_not_exist_for_a_restricted_user(api_per_database: ApiServer) -> None:
    api = api_per_database
    shown, hidden = (create_sample(api.stores.database, api.stores.blobs) for _ in range(2))
    ids = {name: ids_of(api, sample) for name, sample in (("shown", shown), ("hidden", hidden))}
    for role in (Role.LABELLER, Role.TEACHER):
        with api.client(restricted(api, role, shown.experiment.id)[1]) as client:
            for operation in OF_EXPERIMENTS:
                if role not in ALLOWED[operation] or operation.endswith(("events", "jpg", "gif", "camera}.mp4")):
                    continue  # an endless response, images of a clip that is no video, and a view that is not rendered
                statuses = [request(client, operation, **ids[name]).status_code for name in ("shown", "hidden")]
                assert statuses == [200, 404], (role, operation)
            for operation in (
                "GET /experiments/{experiment_id}/events",
                "GET /clips/{clip_id}.jpg",
                "GET /clips/{clip_id}.gif",
                "GET /clips/{clip_id}/views/{camera}.mp4",
            ):
                assert request(client, operation, **ids["hidden"]).status_code == 404
            listed = client.get("/api/v1/experiments").json()["items"]
            assert [each["id"] for each in listed] == [shown.experiment.id]
            # A label on a pair that was never shown to the user
            refused = request(client, "PUT /queries/{query_id}/label", **ids["hidden"])
            assert refused.status_code == (410 if role is Role.LABELLER else 404)


#: what a token for one experiment reaches outside experiments
OUTSIDE_EXPERIMENTS = {"GET /me", "GET /tasks", "GET /experiments", "POST /sign-out"}
PARTS = ("experiment", "query", "clip", "segment", "recording")


def test_a_token_for_one_experiment_reaches_nothing_else(api_per_database: ApiServer) -> None:
    api = api_per_database
    shown, hidden = (create_sample(api.stores.database, api.stores.blobs) for _ in range(2))
    limits = {"name": "one experiment", "experiment_id": shown.experiment.id}
    ids = ids_of(api, hidden)
    with api.client(api.admin.post("/api/v1/tokens", json=limits).json()["token"]) as client:
        for operation in sorted(ALLOWED, key=lambda operation: operation == "POST /sign-out"):
            if operation in OUTSIDE_EXPERIMENTS:
                expected = {200, 204}
            else:
                expected = {404} if any(f"{{{kind}_id}}" in operation for kind in PARTS) else {403}
            assert request(client, operation, **ids).status_code in expected, operation
    with api.client(api.admin.post("/api/v1/tokens", json=limits).json()["token"]) as client:
        assert [each["id"] for each in client.get("/api/v1/experiments").json()["items"]] == [shown.experiment.id]
        reached = ids_of(api, shown)
        for operation in (
            "GET /experiments/{experiment_id}",
            "GET /experiments/{experiment_id}/quality",
            "POST /experiments/{experiment_id}/queries/next",
            "GET /segments/{segment_id}/arrays",
            "GET /clips/{clip_id}.mp4",
        ):
            assert request(client, operation, **reached).status_code == 200, operation


def test_restricted_researchers_see_everything(api: ApiServer) -> None:
    sample = create_sample(api.stores.database, api.stores.blobs)
    user_id, token = restricted(api, Role.LABELLER)
    path = f"/api/v1/experiments/{sample.experiment.id}"
    with api.client(token) as client:
        assert client.get(path).status_code == 404
        api.admin.patch(f"/api/v1/users/{user_id}", json={"role": "researcher"})
        assert client.get(path).status_code == 200


def test_a_label_on_a_pair_shown_before_access_was_taken_away_is_accepted(api_per_database: ApiServer) -> None:
    api = api_per_database
    sample = create_sample(api.stores.database, api.stores.blobs)
    user_id, token = restricted(api, Role.LABELLER, sample.experiment.id)
    with api.client(token) as client:
        query = client.post(f"/api/v1/experiments/{sample.experiment.id}/queries/next").json()["items"][0]
        api.admin.patch(f"/api/v1/users/{user_id}", json={"access": {"all_experiments": False}})
        assert client.put(f"/api/v1/queries/{query['id']}/lease").status_code == 410
        assert client.put(f"/api/v1/queries/{query['id']}/label", json={"label": 1}).status_code == 201
        assert client.delete(f"/api/v1/queries/{query['id']}/label").status_code == 404


@pytest.mark.parametrize("body", [{"role": "labeller"}, {"access": {"all_experiments": False}}])
def test_admins_cannot_lock_themselves_out(api: ApiServer, body: dict[str, Any]) -> None:
    own = f"/api/v1/users/{api.admin.get('/api/v1/me').json()['id']}"
    for response in (api.admin.patch(own, json=body), api.admin.delete(own), api.admin.post(f"{own}/revoke")):
        assert (response.status_code, response.json()["error"]["code"]) == (409, "own_account")
    assert api.admin.get("/api/v1/me").json()["role"] == "admin"
