"""Wrong tokens, sign-in links and invitations are refused with 429 after some failures from one address."""

import itertools
from collections.abc import Generator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from accord.api.sign_in_limit import MAX_ENTRIES_PER_DAY, SignInLimit
from accord.domain.errors import TooManyFailedSignIns
from support.api_in_thread import ApiServer, run_api_server
from support.stores import Stores

FAILURES = 3
NUMBERS = itertools.count()


@pytest.fixture
def strict(sqlite: Stores, tmp_path: Path) -> Generator[ApiServer]:
    """A server that allows few failures."""
    with run_api_server(sqlite, tmp_path, failed_sign_ins_per_minute=FAILURES) as api:
        yield api


def wrong_token(api: ApiServer, **headers: str) -> httpx.Response:
    """Another one in each call."""
    return api.anyone.get("/api/v1/me", headers={"Authorization": f"Bearer wrong-{next(NUMBERS)}", **headers})


def recorded(api: ApiServer) -> list[dict[str, Any]]:
    """Details of the failed sign-ins in the audit log, oldest first."""
    items = api.admin.get("/api/v1/audit", params={"action": "sign_in_failed"}).json()["items"]
    assert all(each["actor_id"] is None for each in items)
    return [each["detail"] for each in reversed(items)]


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


def test_a_browser_whose_session_ended_may_repeat_its_token(strict: ApiServer) -> None:
    assert recorded(strict) == []
    cookie = {"Cookie": "accord_session=ended"}
    # A repetition counts as a tenth of another guess.
    for _ in range(10 * (FAILURES - 1)):
        assert strict.anyone.get("/api/v1/me", headers=cookie).status_code == 401
    assert wrong_token(strict).status_code == 401
    assert_limited(strict.anyone.get("/api/v1/me", headers=cookie))
    assert recorded(strict) == [{"address": "127.0.0.1", "kind": "token", "failures": 1}]


@pytest.mark.parametrize(
    ("path", "kind"), [("/sign-in/{}", "sign-in link"), ("/join/{}", "invitation"), ("/shared", "read-only link")]
)
def test_wrong_links_are_limited(strict: ApiServer, path: str, kind: str) -> None:
    assert recorded(strict) == []

    def get() -> httpx.Response:
        wrong = f"wrong-{next(NUMBERS)}"
        return strict.anyone.get(f"/api/v1{path.format(wrong)}", headers={"Authorization": f"Bearer {wrong}"})

    for _ in range(FAILURES):
        assert get().status_code in {401, 404}
    assert_limited(get())
    assert_limited(wrong_token(strict))
    assert recorded(strict) == [{"address": "127.0.0.1", "kind": kind, "failures": 1}]


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
        assert strict.anyone.post(f"/api/v1/sign-in/wrong-{next(NUMBERS)}").status_code == 401
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
    limit.failed("2001:db8::1", "a")
    limit.failed("2001:db8::2", "b")
    with pytest.raises(TooManyFailedSignIns):
        limit.check("2001:db8::3")
    limit.check("2001:db8:0:1::1")
    limit.check("")  # without an address, as behind a Unix socket


def test_the_audit_log_gets_few_entries_of_many_failures() -> None:
    limit = SignInLimit(10)
    entries = [limit.failed("192.0.2.1", str(number)) for number in range(1000)]
    assert [each for each in entries if each] == [1, 10, 100, 1000]
    others = [limit.failed(f"198.51.{number // 250}.{number % 250}", "wrong") for number in range(MAX_ENTRIES_PER_DAY)]
    assert sum(others) == MAX_ENTRIES_PER_DAY - 4
