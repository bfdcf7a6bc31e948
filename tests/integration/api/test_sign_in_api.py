"""Signing in: a link works once, and the cookie is of no use to other sites."""

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
    with api.client(None) as made:
        response = made.get(urlsplit(link).path)
        assert (response.status_code, response.headers["location"]) == (303, "/")
        yield made


def test_a_link_signs_a_browser_in_once(api_per_database: ApiServer) -> None:
    bob = invite(api_per_database)
    assert bob["sign_in_url"].startswith(f"{api_per_database.url}/sign-in/")
    with browser(api_per_database, bob["sign_in_url"]) as first, api_per_database.client(None) as second:
        assert first.get("/api/v1/me").json() == {"id": bob["id"], "name": "Bob", "role": "labeller"}
        refused = second.get(urlsplit(bob["sign_in_url"]).path)
        assert refused.status_code == 401
        assert "once" in refused.text
        assert "set-cookie" not in refused.headers
        # who is signed in already just gets the page
        assert first.get(urlsplit(bob["sign_in_url"]).path).status_code == 303


@pytest.mark.parametrize("token", ["x", "<script>", "%00", "a" * 3000])
def test_a_link_that_was_never_made_is_refused(api: ApiServer, token: str) -> None:
    refused = api.anyone.get(f"/sign-in/{token}")
    assert refused.status_code == 401
    assert "<script>" not in refused.text


def test_the_cookie_is_for_the_browser_alone(api: ApiServer) -> None:
    with api.client(None) as made:
        cookie = made.get(urlsplit(invite(api)["sign_in_url"]).path).headers["set-cookie"]
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
def test_a_write_with_the_cookie_must_come_from_our_own_page(
    api: ApiServer, headers: dict[str, str], allowed: bool
) -> None:
    with browser(api, invite(api)["sign_in_url"]) as bob:
        filled = {name: value.format(url=api.url) for name, value in headers.items()}
        response = bob.post("/api/v1/sign-out", headers=filled)
        assert response.status_code == (204 if allowed else 403)
        assert bob.get("/api/v1/me", headers=filled).status_code == (401 if allowed else 200)


def test_signing_out_ends_the_session_on_the_server_too(api: ApiServer) -> None:
    with browser(api, invite(api)["sign_in_url"]) as bob:
        stolen = dict(bob.cookies)
        assert bob.post("/api/v1/sign-out", headers={"Origin": api.url}).status_code == 204
        assert dict(bob.cookies) == {}
        with api.client(None, cookies=stolen) as thief:
            assert thief.get("/api/v1/me").status_code == 401


def test_a_bearer_token_goes_before_a_cookie(api: ApiServer) -> None:
    with browser(api, invite(api)["sign_in_url"]) as bob:
        headers = {"Authorization": api.admin.headers["Authorization"]}
        assert bob.get("/api/v1/me", headers=headers).json()["role"] == "admin"


def test_a_token_in_the_address_is_no_token(api: ApiServer) -> None:
    token = api.admin.headers["Authorization"].removeprefix("Bearer ")
    assert api.anyone.get("/api/v1/me", params={"token": token, "access_token": token}).status_code == 401
