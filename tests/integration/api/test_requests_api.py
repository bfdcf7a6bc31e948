"""Request ids, and what the logs of the server say about a request."""

import json
import re
from pathlib import Path
from typing import Any

import httpx
import pytest

from accord.domain.ids import new_id
from support.api_in_thread import ApiServer
from support.api_process import running_server
from support.plain_http import PLAIN_HTTP


def test_every_response_has_a_new_request_id_or_that_of_the_client(api: ApiServer) -> None:
    paths = ("/api/v1/me", "/api/v1/health", "/api/v1/nothing", "/", "/elsewhere")
    ids = [api.anyone.get(path).headers["X-Request-ID"] for path in paths]
    assert len(set(ids)) == len(paths)
    assert all(re.fullmatch(r"req_[0-9a-f]{24}", id) for id in ids)
    wrong_host = api.anyone.get("/", headers={"Host": "evil.example", "X-Request-ID": "proxy-1.2_3"})
    assert (wrong_host.status_code, wrong_host.headers["X-Request-ID"]) == (421, "proxy-1.2_3")


@pytest.mark.parametrize("forged", [b"", b"a b", b"x" * 65, b'"', b"\xc3\xbc"])
def test_a_request_id_that_could_forge_a_line_is_replaced(api: ApiServer, forged: bytes) -> None:
    assert api.anyone.get("/", headers={"X-Request-ID": forged}).headers["X-Request-ID"].startswith("req_")  # type: ignore[dict-item]


def logged(log: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.read_text().splitlines()]


def test_lines_name_the_request_and_the_experiment_but_no_secret(tmp_path: Path) -> None:
    experiment_id = new_id("exp")
    with running_server(tmp_path, {"ACCORD_LOG_FORMAT": "json", "ACCORD_LOG_REQUESTS": "true"}) as server:
        with httpx.Client(base_url=server.url, headers={"Authorization": "Bearer wrong"}, **PLAIN_HTTP) as client:
            client.post("/api/v1/sign-in/a-secret", headers={"X-Request-ID": "one"})
            client.get(f"/api/v1/experiments/{experiment_id}", headers={"X-Request-ID": "two"})
            client.get("/labelling", headers={"X-Request-ID": "three"})
        assert server.stop() == 0
    lines = {line.get("request_id", line["event"]): line for line in logged(server.log)}
    assert {line["worker_id"] for line in lines.values()} == {"api"}
    assert all(line["timestamp"].endswith("Z") and line["level"] and line["logger"] for line in lines.values())
    one, two, three = (lines[id] for id in ("one", "two", "three"))
    assert (one["method"], one["route"], one["status"]) == ("POST", "/sign-in/{token}", 401)
    assert (two["route"], two["experiment_id"]) == ("/experiments/{experiment_id}", experiment_id)
    assert (three["route"], three["status"], three["seconds"] > 0) == ("page", 200, True)
    assert "a-secret" not in server.log.read_text()
