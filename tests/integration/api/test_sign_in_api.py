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
    """A client that opened a sign-in link."""
    with api.client(None) as client:
        response = client.get(urlsplit(link).path)
        assert (response.status_code, response.headers["location"]) == (303, "/")
        yield client


def test_link_signs_in_one_browser_once(api_per_database: ApiServer) -> None:
    bob = invite(api_per_database)
    assert bob["sign_in_url"].startswith(f"{api_per_database.url}/sign-in/")
    with browser(api_per_database, bob["sign_in_url"]) as first, api_per_database.client(None) as second:
        assert first.get("/api/v1/me").json() == {"id": bob["id"], "name": "Bob", "role": "labeller"}
        refused = second.get(urlsplit(bob["sign_in_url"]).path)
        assert refused.status_code == 401
        assert "set-cookie" not in refused.headers
        # A signed-in browser that opens the link again is redirected to the page.
        assert first.get(urlsplit(bob["sign_in_url"]).path).status_code == 303


@pytest.mark.parametrize("token", ["x", "<script>", "%00", "a" * 3000])
def test_unknown_link_is_refused(api: ApiServer, token: str) -> None:
    refused = api.anyone.get(f"/sign-in/{token}")
    assert refused.status_code == 401
    assert "<script>" not in refused.text


def test_cookie_has_its_security_attributes(api: ApiServer) -> None:
    with api.client(None) as client:
        cookie = client.get(urlsplit(invite(api)["sign_in_url"]).path).headers["set-cookie"]
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
