"""Sign-in links, the session cookie and its protection against requests of other sites."""

from collections.abc import Generator
from contextlib import contextmanager
from urllib.parse import urlsplit

import httpx
import pytest

from support.api_in_thread import ApiServer


def invite(api: ApiServer, name: str = "Bob") -> dict[str, str]:
    response = api.admin.post("/api/v1/users", json={"name": name, "role": "labeller"})
    assert response.status_code == 201
    return response.json()


@contextmanager
def browser(api: ApiServer, link: str) -> Generator[httpx.Client]:
    """A client that redeemed a sign-in link."""
    with api.client(None) as client:
        assert client.post(api_path(link)).status_code == 200
        yield client


def api_path(link: str) -> str:
    """Where the page looks at a sign-in link, and redeems it."""
    return f"/api/v1{urlsplit(link).path}"


def test_link_signs_in_one_browser_once(api_per_database: ApiServer) -> None:
    bob = invite(api_per_database)
    assert bob["sign_in_url"].startswith(f"{api_per_database.url}/sign-in/")
    with browser(api_per_database, bob["sign_in_url"]) as first, api_per_database.client(None) as second:
        assert first.get("/api/v1/me").json() == {"id": bob["id"], "name": "Bob", "role": "labeller"}
        for refused in (second.post(api_path(bob["sign_in_url"])), second.get(api_path(bob["sign_in_url"]))):
            assert refused.status_code == 401
            assert "set-cookie" not in refused.headers


def test_looking_at_a_link_uses_nothing_up(api_per_database: ApiServer) -> None:
    bob = invite(api_per_database)
    with api_per_database.client(None) as preview:
        for _ in range(3):
            # First the page itself, which these tests do not build; then the request that the page makes.
            preview.get(urlsplit(bob["sign_in_url"]).path)
            assert preview.get(api_path(bob["sign_in_url"])).json() == {"name": "Bob", "role": "labeller"}
        assert not preview.cookies
        assert preview.post(api_path(bob["sign_in_url"])).json()["name"] == "Bob"


@pytest.mark.parametrize("site", ["cross-site", "same-site", "none"])
def test_a_page_of_another_site_cannot_sign_its_visitor_in(api: ApiServer, site: str) -> None:
    bob = invite(api)
    refused = api.anyone.post(api_path(bob["sign_in_url"]), headers={"Sec-Fetch-Site": site})
    assert refused.status_code == 403
    invitation = urlsplit(api.admin.post("/api/v1/invitations", json={}).json()["url"]).path
    headers = {"Sec-Fetch-Site": site}
    assert api.anyone.post(f"/api/v1{invitation}", json={"name": "x"}, headers=headers).status_code == 403
    assert api.anyone.post(api_path(bob["sign_in_url"])).status_code == 200


@pytest.mark.parametrize("token", ["x", "<script>", "%00", "a" * 200])
def test_unknown_link_is_refused(api: ApiServer, token: str) -> None:
    for refused in (api.anyone.get(f"/api/v1/sign-in/{token}"), api.anyone.post(f"/api/v1/sign-in/{token}")):
        assert refused.status_code == 401
        assert "<script>" not in refused.text


def test_cookie_has_its_security_attributes(api: ApiServer) -> None:
    with api.client(None) as client:
        cookie = client.post(api_path(invite(api)["sign_in_url"])).headers["set-cookie"]
    flags = {part.strip().lower() for part in cookie.split(";")[1:]}
    assert {"httponly", "samesite=lax", "path=/"} <= flags
    assert f"max-age={30 * 86_400}" in flags


@pytest.mark.parametrize(
    ("headers", "allowed"),
    [
        ({}, False),
        ({"Origin": "https://evil.example"}, False),
        ({"Origin": "null"}, False),
        ({"Sec-Fetch-Site": "cross-site", "Origin": "{url}"}, False),
        ({"Sec-Fetch-Site": "same-site"}, False),
        ({"Sec-Fetch-Site": "none"}, False),
        ({"Sec-Fetch-Site": "same-origin"}, True),
        ({"Origin": "{url}"}, True),
    ],
)
def test_write_with_the_cookie_must_come_from_the_same_origin(
    api: ApiServer, headers: dict[str, str], allowed: bool
) -> None:
    with browser(api, invite(api)["sign_in_url"]) as bob:
        sent = {name: value.format(url=api.url) for name, value in headers.items()}
        response = bob.post("/api/v1/sign-out", headers=sent)
        assert response.status_code == (204 if allowed else 403)
        assert bob.get("/api/v1/me", headers=sent).status_code == (401 if allowed else 200)


def test_sign_out_invalidates_the_cookie_on_the_server(api: ApiServer) -> None:
    with browser(api, invite(api)["sign_in_url"]) as bob:
        cookies = dict(bob.cookies)
        assert bob.post("/api/v1/sign-out", headers={"Origin": api.url}).status_code == 204
        assert dict(bob.cookies) == {}
        with api.client(None, cookies=cookies) as other:
            assert other.get("/api/v1/me").status_code == 401


def test_bearer_token_takes_precedence_over_the_cookie(api: ApiServer) -> None:
    with browser(api, invite(api)["sign_in_url"]) as bob:
        headers = {"Authorization": api.admin.headers["Authorization"]}
        assert bob.get("/api/v1/me", headers=headers).json()["role"] == "admin"


def test_token_in_the_query_string_is_ignored(api: ApiServer) -> None:
    token = api.admin.headers["Authorization"].removeprefix("Bearer ")
    assert api.anyone.get("/api/v1/me", params={"token": token, "access_token": token}).status_code == 401
