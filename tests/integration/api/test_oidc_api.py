"""Sign-in through a real OpenID Connect provider, and everything that must not sign anybody in."""

import base64
import json
from collections.abc import Generator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from pydantic import ValidationError

from accord.settings import Settings
from support.api_in_thread import ApiServer, run_api_server
from support.oidc_provider import OidcProvider, running_oidc_provider
from support.stores import Stores

pytestmark = pytest.mark.slow

START, CALLBACK = "/api/v1/oidc/start", "/api/v1/oidc/callback"


@pytest.fixture(scope="module")
def provider() -> Generator[OidcProvider]:
    with running_oidc_provider() as running:
        yield running


@pytest.fixture
def api(stores: Stores, tmp_path: Path, provider: OidcProvider) -> Generator[ApiServer]:
    with run_api_server(stores, tmp_path, **provider.settings()) as server:
        yield server


@pytest.fixture
def browser(api: ApiServer) -> Generator[httpx.Client]:
    with api.client(None) as client:
        yield client


def returned(browser: httpx.Client, **query: str) -> str:
    """Begin to sign in; the address to which the provider sends the browser back."""
    begun = browser.get(START, params=query)
    assert begun.status_code in {302, 303}, begun.text
    return browser.get(begun.headers["Location"]).headers["Location"]


def sign_in(browser: httpx.Client, **query: str) -> str:
    """Sign in; the page that the browser shows then."""
    ended = browser.get(returned(browser, **query))
    assert ended.status_code == 303
    return ended.headers["Location"]


def me(browser: httpx.Client) -> dict[str, Any]:
    response = browser.get("/api/v1/me")
    assert response.status_code == 200, response.text
    return response.json()


def is_refused(browser: httpx.Client, page: str, code: str = "sign_in_invalid") -> bool:
    assert page == f"/?sign_in_error={code}"
    return browser.get("/api/v1/me").status_code == 401


def entries(api: ApiServer, action: str) -> list[dict[str, Any]]:
    return api.admin.get("/api/v1/audit", params={"action": action}).json()["items"]


def test_the_first_sign_in_creates_a_labeller_who_is_recognised_later(
    api: ApiServer, browser: httpx.Client, provider: OidcProvider
) -> None:
    assert browser.get("/api/v1/oidc").json() == {"name": "the lab"}
    provider.person("ada", name="Ada Lovelace")
    assert sign_in(browser, next="/experiments/new?from=1") == "/experiments/new?from=1"
    ada = me(browser)
    assert (ada["name"], ada["role"]) == ("Ada Lovelace", "labeller")
    provider.person("ada", name="Ada King")
    with api.client(None) as other:
        assert sign_in(other) == "/"
        assert me(other) == ada
    [added] = entries(api, "user_added")
    assert (added["actor_id"], added["subject_id"]) == (ada["id"], ada["id"])
    assert added["detail"] == {"role": "labeller", "provider": provider.url}
    assert [each["actor_id"] for each in entries(api, "signed_in")] == [ada["id"]] * 2
    browser.post("/api/v1/sign-out", headers={"Origin": api.url})
    assert browser.get("/api/v1/me").status_code == 401


def test_people_of_one_name_are_different_users(api: ApiServer, provider: OidcProvider) -> None:
    found: list[tuple[str, str]] = []
    for sub, name in (("1", "Ada\u202e  B\n"), ("2", "Ada B"), ("3", "the admin"), ("4", "")):
        provider.person(sub, name=name)
        with api.client(None) as browser:
            sign_in(browser)
            found.append((me(browser)["name"], me(browser)["role"]))
    assert found == [(name, "labeller") for name in ("Ada B", "Ada B 2", "the admin 2", "4")]


@pytest.mark.parametrize(
    "fault",
    [
        {"id_token": {"nonce": "of another sign-in"}},
        {"id_token": {"nonce": None}},
        {"id_token": {"aud": "another-client"}},
        {"id_token": {"iss": "https://accounts.example"}},
        {"id_token": {"exp": 1_700_003_600, "iat": 1_700_000_000}},
        {"id_token": {"exp": None}},
        {"id_token": {"sub": None}},
        {"id_token": {"sub": ""}},
        {"id_token": {"sub": "x" * 256}},
        {"key": "other"},
        {"key": "secret"},
        {"key": "none"},
        {"error": "access_denied"},
    ],
    ids=str,
)
def test_an_invalid_response_signs_nobody_in(
    api: ApiServer, browser: httpx.Client, provider: OidcProvider, fault: dict[str, Any]
) -> None:
    provider.person("ada", name="Ada", **fault)
    assert is_refused(browser, sign_in(browser))
    assert entries(api, "user_added") == []
    [failed] = entries(api, "sign_in_failed")
    assert failed["detail"] == {"address": "127.0.0.1", "kind": "identity provider", "failures": 1}


def test_a_response_counts_once_and_only_in_the_browser_that_began(
    api: ApiServer, browser: httpx.Client, provider: OidcProvider
) -> None:
    provider.person("ada", name="Ada")
    address = returned(browser)
    with api.client(None) as victim:
        # Somebody else's link, without and with a sign-in of one's own.
        assert is_refused(victim, victim.get(address).headers["Location"])
        returned(victim)
        assert is_refused(victim, victim.get(address).headers["Location"])
    state = browser.cookies["accord_oidc"]
    assert browser.get(address).headers["Location"] == "/"
    assert "accord_oidc" not in browser.cookies
    with api.client(None) as replaying:
        # With the cookie of the browser, the provider refuses the code.
        replaying.cookies.set("accord_oidc", state)
        assert is_refused(replaying, replaying.get(address).headers["Location"])


@pytest.mark.parametrize("part", ["code_verifier", "nonce", "redirect_uri", "malformed", None])
def test_the_code_is_bound_to_the_browser(
    api: ApiServer, browser: httpx.Client, provider: OidcProvider, part: str | None
) -> None:
    provider.person("ada", name="Ada")
    address = returned(browser)
    stored = json.loads(base64.urlsafe_b64decode(browser.cookies["accord_oidc"]))
    [name] = stored.keys() - {"next"}
    if part == "malformed":
        stored[name] = "text"
    elif part is not None:
        stored[name]["data"][part] += "x"
    changed = base64.urlsafe_b64encode(json.dumps(stored if part else [1]).encode()).decode()
    with api.client(None) as other:
        other.cookies.set("accord_oidc", changed)
        assert is_refused(other, other.get(address).headers["Location"])


def test_the_state_cookie_is_for_this_sign_in_only(browser: httpx.Client, api: ApiServer) -> None:
    begun = browser.get(START)
    cookie = begun.headers["Set-Cookie"]
    assert all(part in cookie for part in ("HttpOnly", "SameSite=lax", "Path=/api/v1/oidc;", "Max-Age=600"))
    asked = parse_qs(urlsplit(begun.headers["Location"]).query)
    assert asked["redirect_uri"] == [f"{api.url}{CALLBACK}"]
    assert asked["scope"] == ["openid profile email"]
    assert {"state", "nonce", "code_challenge"} <= asked.keys()


def test_the_page_afterwards_is_one_of_this_server(browser: httpx.Client) -> None:
    for elsewhere in ("https://evil.example", "//evil.example", "/\\evil.example", "evil", "/a\r\nb"):
        assert browser.get(START, params={"next": elsewhere}).status_code == 422


def test_a_new_key_of_the_provider_is_fetched(browser: httpx.Client, api: ApiServer, provider: OidcProvider) -> None:
    provider.person("ada", name="Ada")
    assert sign_in(browser) == "/"
    provider.post("/rotate", {})
    with api.client(None) as other:
        assert sign_in(other) == "/"


def test_people_who_were_disabled_or_removed_are_refused(
    api: ApiServer, browser: httpx.Client, provider: OidcProvider
) -> None:
    provider.person("ada", name="Ada")
    sign_in(browser)
    path = f"/api/v1/users/{me(browser)['id']}"
    api.admin.patch(path, json={"disabled": True})
    assert is_refused(browser, sign_in(browser), "sign_in_refused")
    api.admin.patch(path, json={"disabled": False})
    assert sign_in(browser) == "/"
    # Kept, although they have done nothing: they would be another user the next time.
    assert api.admin.delete(path).json() == {"deleted": False}
    assert is_refused(browser, sign_in(browser), "sign_in_refused")
    # The provider's identifier is forgotten with the name.
    api.admin.delete(path, params={"anonymise": True})
    assert sign_in(browser) == "/"
    assert me(browser)["id"] not in path


def test_roles_follow_the_groups(sqlite: Stores, tmp_path: Path, provider: OidcProvider) -> None:
    roles = "staff=researcher, ops=admin, students=labeller"
    with run_api_server(sqlite, tmp_path, **provider.settings(oidc_role="", oidc_roles=roles)) as api:
        for groups, role in ((["students", "staff"], "researcher"), (["ops"], "admin"), ("students", "labeller")):
            provider.person("ada", name="Ada", groups=groups)
            with api.client(None) as browser:
                assert sign_in(browser) == "/"
                assert me(browser)["role"] == role
        changes = [each["detail"]["role"] for each in reversed(entries(api, "user_changed"))]
        assert changes == [["researcher", "admin"], ["admin", "labeller"]]
        for claims in ({"groups": ["others"]}, {"groups": []}, {}, {"groups": 5}):
            provider.person("ada", name="Ada", **claims)
            with api.client(None) as browser:
                assert is_refused(browser, sign_in(browser), "sign_in_refused")
        # Some providers send more to the userinfo endpoint than in the ID token.
        provider.person("eve", userinfo={"sub": "eve", "name": "Eve", "groups": ["staff"]})
        with api.client(None) as browser:
            sign_in(browser)
            assert (me(browser)["name"], me(browser)["role"]) == ("Eve", "researcher")
        provider.person("mallory", userinfo={"sub": "eve", "name": "Eve", "groups": ["staff"]})
        with api.client(None) as browser:
            assert is_refused(browser, sign_in(browser))


def test_roles_given_by_an_admin_stay_without_groups(
    api: ApiServer, browser: httpx.Client, provider: OidcProvider
) -> None:
    provider.person("ada", name="Ada", groups=["anything"])
    sign_in(browser)
    api.admin.patch(f"/api/v1/users/{me(browser)['id']}", json={"role": "researcher"})
    sign_in(browser)
    assert me(browser)["role"] == "researcher"


def test_signing_out_of_the_provider_leads_back(browser: httpx.Client, api: ApiServer) -> None:
    away = browser.get("/api/v1/oidc/sign-out").headers["Location"]
    assert urlsplit(browser.get(away).headers["Location"])._replace(query="").geturl() == f"{api.url}/"


def test_a_provider_that_is_away_is_said_so(sqlite: Stores, tmp_path: Path) -> None:
    settings = {"oidc_issuer": "http://127.0.0.1:1", "oidc_client_id": "accord"}
    with run_api_server(sqlite, tmp_path, **settings) as api, api.client(None) as browser:
        assert browser.get(START).headers["Location"] == "/?sign_in_error=provider_unreachable"


def test_a_provider_of_another_name_is_refused(sqlite: Stores, tmp_path: Path, provider: OidcProvider) -> None:
    with run_api_server(sqlite, tmp_path, **provider.settings(oidc_issuer=f"{provider.url}/")) as api:
        assert api.anyone.get(START).headers["Location"] == "/?sign_in_error=sign_in_invalid"


def test_without_a_provider_there_is_none(sqlite: Stores, tmp_path: Path) -> None:
    with run_api_server(sqlite, tmp_path) as api:
        assert api.anyone.get("/api/v1/oidc").json() == {"name": None}
        for path in (START, CALLBACK, "/api/v1/oidc/sign-out"):
            assert api.anyone.get(path).json()["error"]["code"] == "no_provider"


def test_failed_sign_ins_are_limited(sqlite: Stores, tmp_path: Path, provider: OidcProvider) -> None:
    with run_api_server(sqlite, tmp_path, **provider.settings(failed_sign_ins_per_minute=2)) as api:
        for number, code in enumerate(["sign_in_invalid", "sign_in_invalid", "too_many_failed_sign_ins"]):
            response = api.anyone.get(CALLBACK, params={"state": str(number), "code": "x"})
            assert response.headers["Location"] == f"/?sign_in_error={code}"


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"oidc_issuer": "http://accounts.example", "oidc_client_id": "x"}, "oidc_issuer"),
        ({"oidc_issuer": "accounts.example", "oidc_client_id": "x"}, "oidc_issuer"),
        ({"oidc_issuer": "https://accounts.example"}, "oidc_client_id"),
        ({"oidc_roles": "staff=boss"}, "oidc_roles"),
        ({"oidc_roles": "staff"}, "oidc_roles"),
        ({"oidc_role": "boss"}, "oidc_role"),
    ],
)
def test_invalid_settings_are_named(settings: dict[str, str], field: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Settings(**settings)  # type: ignore[arg-type]
    assert field in {str(each["loc"][0]) for each in caught.value.errors()}


def test_the_secret_is_not_printed() -> None:
    assert "hush" not in repr(Settings(oidc_client_secret="hush"))  # type: ignore[arg-type]
