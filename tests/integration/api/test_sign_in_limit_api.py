"""Wrong tokens, sign-in links and invitations are refused with 429 after some failures from one address."""

from collections.abc import Generator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from accord.api.sign_in_limit import SignInLimit
from accord.domain.errors import TooManyFailedSignIns
from support.api_in_thread import ApiServer, run_api_server
from support.stores import Stores

FAILURES = 3


@pytest.fixture
def strict(sqlite: Stores, tmp_path: Path) -> Generator[ApiServer]:
    """A server that allows few failures."""
    with run_api_server(sqlite, tmp_path, failed_sign_ins_per_minute=FAILURES) as api:
        yield api


def wrong_token(api: ApiServer, **headers: str) -> httpx.Response:
    return api.anyone.get("/api/v1/me", headers={"Authorization": "Bearer wrong", **headers})


def assert_limited(response: httpx.Response) -> None:
    assert (response.status_code, response.json()["error"]["code"]) == (429, "too_many_failed_sign_ins")
    assert int(response.headers["Retry-After"]) > 0


def test_wrong_tokens_are_limited(strict: ApiServer) -> None:
    assert [wrong_token(strict).status_code for _ in range(FAILURES)] == [401] * FAILURES
    assert_limited(wrong_token(strict))
    assert_limited(strict.anyone.post("/api/v1/experiments", json={}, headers={"Authorization": "Bearer other"}))
    assert_limited(strict.anyone.get("/api/v1/me", headers={"Cookie": "accord_session=wrong"}))
    # Without a token there is nothing to try.
    assert strict.anyone.get("/api/v1/me").status_code == 401
    assert strict.anyone.get("/api/v1/health").status_code == 200


@pytest.mark.parametrize("path", ["/api/v1/sign-in/wrong", "/api/v1/join/wrong", "/api/v1/shared"])
def test_wrong_links_are_limited(strict: ApiServer, path: str) -> None:
    headers = {"Authorization": "Bearer wrong"} if path.endswith("shared") else {}
    for _ in range(FAILURES):
        assert strict.anyone.get(path, headers=headers).status_code in {401, 404}
    assert_limited(strict.anyone.get(path, headers=headers))
    assert_limited(wrong_token(strict))


def test_people_who_were_signed_in_before_are_not_limited(strict: ApiServer) -> None:
    assert strict.labeller.get("/api/v1/me").status_code == 200
    while wrong_token(strict).status_code == 401:
        pass
    assert strict.labeller.get("/api/v1/me").status_code == 200
    # A token that the server has not seen waits.
    assert_limited(strict.teacher.get("/api/v1/me"))


def test_revoked_token_counts_as_a_failure(strict: ApiServer) -> None:
    for _ in range(FAILURES):
        user = strict.admin.post("/api/v1/users", json={"name": "Ada", "role": "labeller"}).json()
        with strict.client(user["token"]) as ada:
            assert ada.get("/api/v1/me").status_code == 200
            strict.admin.delete(f"/api/v1/users/{user['id']}")
            assert ada.get("/api/v1/me").status_code == 401
    assert_limited(wrong_token(strict))


def test_valid_link_signs_in_after_fewer_failures(strict: ApiServer) -> None:
    for _ in range(FAILURES - 1):
        assert strict.anyone.post("/api/v1/sign-in/wrong").status_code == 401
    link = strict.admin.post("/api/v1/users", json={"name": "Ada", "role": "labeller"}).json()["sign_in_url"]
    assert strict.anyone.post(f"/api/v1{urlsplit(link).path}").status_code == 200


def test_forwarded_address_counts_only_behind_a_trusted_proxy(sqlite: Stores, tmp_path: Path) -> None:
    changes = {"failed_sign_ins_per_minute": FAILURES}
    with run_api_server(sqlite, tmp_path, **changes) as api:
        statuses = {wrong_token(api, **{"X-Forwarded-For": f"192.0.2.{i}"}).status_code for i in range(FAILURES + 1)}
        assert 429 in statuses
    public = changes | {"public_url": "https://accord.example"}
    with run_api_server(sqlite, tmp_path, **public, trusted_proxies="198.51.100.7") as api:
        statuses = {wrong_token(api, **{"X-Forwarded-For": f"192.0.2.{i}"}).status_code for i in range(FAILURES + 1)}
        assert 429 in statuses
    with run_api_server(sqlite, tmp_path, **public, trusted_proxies="127.0.0.1") as api:
        for i in range(FAILURES + 1):
            assert wrong_token(api, **{"X-Forwarded-For": f"192.0.2.{i}"}).status_code == 401
        # The proxy appends the address of its client; what the client wrote before it does not count.
        for i in range(FAILURES):
            forged = f"203.0.113.{i}, 192.0.2.200"
            assert wrong_token(api, **{"X-Forwarded-For": forged}).status_code == 401
        assert_limited(wrong_token(api, **{"X-Forwarded-For": "192.0.2.200"}))


def test_addresses_of_one_ipv6_network_count_together() -> None:
    limit = SignInLimit(2)
    limit.failed("2001:db8::1")
    limit.failed("2001:db8::2")
    with pytest.raises(TooManyFailedSignIns):
        limit.check("2001:db8::3")
    limit.check("2001:db8:0:1::1")
    limit.check("")  # without an address, as behind a Unix socket
