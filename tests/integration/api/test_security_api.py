"""Headers that restrict browsers, the hosts for which the server answers, and what strangers learn."""

import socket
from pathlib import Path

import httpx
import pytest

from accord.api.security import AllowedHosts
from accord.settings import Settings
from support.api_in_thread import ApiServer, run_api_server
from support.stores import Stores


def assert_restricted(response: httpx.Response) -> None:
    policy = {
        name: sources for name, *sources in map(str.split, response.headers["content-security-policy"].split(";"))
    }
    assert policy["default-src"] == policy["frame-ancestors"] == policy["base-uri"] == ["'none'"]
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == policy["form-action"] == ["'self'"]
    assert response.headers["x-content-type-options"] == "nosniff"
    assert response.headers["referrer-policy"] == "same-origin"


def test_every_response_restricts_the_browser(api: ApiServer, monkeypatch: pytest.MonkeyPatch) -> None:
    for client, path, status in (
        (api.anyone, "/api/v1/health", 200),
        (api.labeller, "/api/v1/me", 200),
        (api.anyone, "/api/v1/me", 401),
        (api.anyone, "/api/nothing", 404),
        (api.anyone, "/" + "a" * 3000, 414),
    ):
        response = client.get(path)
        assert response.status_code == status
        assert_restricted(response)
    assert_restricted(api.anyone.get("/"))
    assert_restricted(api.anyone.get("/api/v1/me", headers={"Host": "evil.example"}))

    def fail(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("accord.services.accounts.summaries", fail)
    failed = api.admin.get("/api/v1/users")
    assert failed.status_code == 500
    assert_restricted(failed)


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8000", "127.0.0.1.evil.example", "", "[", "192.0.2.1"])
def test_requests_for_other_hosts_are_refused(api: ApiServer, host: str) -> None:
    response = api.admin.get("/api/v1/me", headers={"Host": host})
    assert (response.status_code, response.json()["error"]["code"]) == (421, "host_not_allowed")


def test_the_setting_allows_further_hosts(sqlite: Stores, tmp_path: Path) -> None:
    settings = {"allowed_hosts": "accord.lab, Other.Lab", "public_url": "https://accord.example/"}
    with run_api_server(sqlite, tmp_path, **settings) as api:
        for host in ("accord.lab", "ACCORD.LAB:80", "other.lab", "accord.example", "localhost:1", "[::1]:8000"):
            assert api.anyone.get("/api/v1/health", headers={"Host": host}).status_code == 200, host
        assert api.anyone.get("/api/v1/health", headers={"Host": "evil.example"}).status_code == 421


def test_a_server_on_all_addresses_answers_for_them_and_for_its_name(tmp_path: Path) -> None:
    hosts = AllowedHosts(Settings(home=tmp_path, host="0.0.0.0"))
    assert all(each in hosts for each in ("192.0.2.1:8000", "[2001:db8::1]", socket.gethostname()))
    assert "evil.example" not in hosts
    one = AllowedHosts(Settings(home=tmp_path, host="192.0.2.1"))
    assert "192.0.2.1:8000" in one
    assert "192.0.2.2" not in one
    assert "evil.example" in AllowedHosts(Settings(home=tmp_path, allowed_hosts="*"))


def test_only_those_who_are_signed_in_read_the_description_of_the_api(api: ApiServer) -> None:
    assert api.anyone.get("/api/openapi.json").status_code == 401
    assert "/api/v1/me" in api.labeller.get("/api/openapi.json").json()["paths"]


def test_strangers_learn_nothing_of_the_database(api: ApiServer) -> None:
    path = Path(api.stores.database_url.removeprefix("sqlite:///"))
    api.stores.database.close()
    path.write_bytes(b"not a database" * 1000)
    for companion in (f"{path}-wal", f"{path}-shm"):
        Path(companion).unlink(missing_ok=True)
    ready, me = api.anyone.get("/api/v1/ready"), api.anyone.get("/api/v1/me", headers={"Authorization": "Bearer x"})
    assert (ready.status_code, ready.json()["error"]["code"]) == (503, "unavailable")
    assert (me.status_code, me.json()["error"]["code"]) == (503, "database_unreachable")
    assert "database" not in ready.text
    assert path.name not in me.text
    assert "sqlite" not in me.text
