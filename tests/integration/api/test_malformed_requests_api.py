"""Extreme values in every field, parameter, path and header: refused, never a failure of the server."""

import json
import socket
from collections.abc import Iterator
from typing import Any, cast
from urllib.parse import urlsplit

import httpx
import pytest

from accord.api.openapi import document
from accord.domain.ids import new_id
from support.api_in_thread import ApiServer
from support.sample_experiments import create_sample
from support.waiting import PATIENCE_SECONDS

JSON = {"Content-Type": "application/json"}
#: as JSON writes them
EXTREME_VALUES = (
    "9" * 4000,
    "9" * 5000,
    "NaN",
    "-Infinity",
    "9223372036854775808",
    r'"\ud800"',
    r'"\u0000"',
    r'{"\ud800": [NaN]}',
)
EXTREME_PARAMETERS = ("9" * 4000, "9" * 5000, "-1", "NaN", "%ED%A0%80", "%00", "x" * 3000)
#: operations that would change what later requests use, and the endless stream
_ENDING = ("/pause", "/cancel", "/archive", "/sign-out", "/revoke", "/events")


def operations() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Method, path and description of every operation whose requests cannot disturb the others."""
    for path, methods in json.loads(document())["paths"].items():
        for method, operation in methods.items():
            if not path.endswith(_ENDING) and (method != "delete" or "requestBody" in operation):
                yield method, path, operation


def fields_of(operation: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The required fields of a request body with some values, and the names of all fields."""
    schemas = json.loads(document())["components"]["schemas"]
    reference = operation["requestBody"]["content"]["application/json"]["schema"]["$ref"]
    schema = schemas[reference.rpartition("/")[2]]
    examples = {"integer": 1, "number": 1, "boolean": True, "array": [], "object": {}}
    properties = schema["properties"]
    required = {name: examples.get(properties[name].get("type"), "ant") for name in schema.get("required", [])}
    return required, list(properties)


@pytest.mark.slow
def test_extreme_values_in_any_field_are_no_failure_of_the_server(
    api_per_database: ApiServer, caplog: pytest.LogCaptureFixture
) -> None:
    api, failed = api_per_database, list[str]()
    sample = create_sample(api.stores.database, api.stores.blobs)
    ids = {
        "experiment_id": sample.experiment.id,
        "query_id": sample.query_ids[0],
        "clip_id": new_id("clp"),
        "segment_id": sample.segment_ids[0],
        "user_id": sample.owner.id,
        "token": "none",
        "number": "1",
        "camera": "top",
        "invitation_id": "x",
        "recording_id": "x",
        "share_id": "x",
        "webhook_id": "x",
    }

    def send(method: str, path: str, **options: Any) -> None:
        try:
            status = api.admin.request(method, path, **options).status_code
        except httpx.TransportError:
            status = 500  # the server closes the connection after a failure
        if status >= 500:
            failed.append(f"{method} {path[:200]} {str(options)[:100]}")

    for method, path, operation in operations():
        known = path.format_map(ids)
        for parameter in operation.get("parameters", []):
            for value in EXTREME_PARAMETERS:
                if parameter["in"] == "query":
                    send(method, f"{known}?{parameter['name']}={value}")
                elif parameter["in"] == "path":
                    send(method, path.format_map(ids | {parameter["name"]: value}))
        if "application/json" in operation.get("requestBody", {}).get("content", {}):
            required, names = fields_of(operation)
            for value in EXTREME_VALUES:
                bodies = [value, *(json.dumps(required | {name: 0}) for name in names)]
                for name, body in zip(["", *names], bodies, strict=True):
                    text = body.replace(f'"{name}": 0', f'"{name}": {value}') if name else body
                    send(method, known, content=text.encode(), headers=JSON)
    assert failed == []
    assert "Traceback" not in caplog.text


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ('"seed": ' + "9" * 4000, "seed"),
        ('"control_share": ' + "9" * 4000, "control_share"),
        ('"control_share": NaN', "control_share"),
        ('"policy": {"clip": Infinity}', "policy.clip"),
        ('"policy": {"hidden": [NaN]}', "policy.hidden"),
        (r'"policy": {"\ud800": 1}', r"policy.\ud800"),
    ],
)
def test_setting_that_is_no_finite_number_is_refused(api_per_database: ApiServer, settings: str, field: str) -> None:
    content = f'{{"name": "one", "task": "HalfCheetah-6x1", {settings}}}'.encode()
    response = api_per_database.researcher.post("/api/v1/experiments", content=content, headers=JSON)
    assert response.status_code == 422, response.text
    assert response.json()["error"]["details"][0]["field"] == field


def test_body_that_cannot_be_parsed_is_refused(api: ApiServer) -> None:
    for content in (b"9" * 5000, b"[" * 100_000, b'{"name": ' + b"9" * 5000 + b"}"):
        response = api.researcher.post("/api/v1/experiments", content=content, headers=JSON)
        assert (response.status_code, response.json()["error"]["code"]) == (422, "invalid_request")


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/" + "a" * 5000, 414),
        ("/" + "a/" * 2500, 414),
        ("/assets/" + "a" * 300, 404),
        ("/assets/%ED%A0%80", 404),
        ("/assets/%00", 404),
        ("/api/v1/" + "a" * 5000, 414),
        ("/sign-in/" + "a" * 5000, 414),
    ],
)
def test_path_that_nothing_can_have_is_refused(api: ApiServer, path: str, status: int) -> None:
    assert api.anyone.get(path).status_code == status


@pytest.mark.parametrize("path", ["/", "/api/v1/me", "/api/v1/experiments"])
def test_websocket_handshake_is_refused(api: ApiServer, path: str) -> None:
    address = urlsplit(api.url)
    handshake = (
        f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    with socket.create_connection(cast(Any, (address.hostname, address.port)), PATIENCE_SECONDS) as connection:
        connection.sendall(handshake.encode())
        assert connection.recv(100).startswith(b"HTTP/1.1 400 ")
